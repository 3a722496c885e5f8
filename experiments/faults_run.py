"""One fault: a small command under strace, which kills it or fills its disk at one system call, then the same again."""

from __future__ import annotations

import collections
import dataclasses
import functools
import os
import pathlib
import re
import shutil
import subprocess
import sys
from typing import Any

from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments import faults_found
from experiments.faults_found import Result
from experiments.runs import PROGRAMS

FILTER = "--seccomp-bpf"
"""Option by which strace stops a process at the calls that it traces only; it then sends no signals (version 6.1)."""
PATIENCE = 300.0
"""Seconds after which a command counts as hung."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A small command whose faults are tried."""

    name: str
    words: tuple[str, ...]  # `{data}` stands for the folder of its inputs
    needs: tuple[
        tuple[str, tuple[str, ...]], ...
    ] = ()  # its inputs: names in that folder, and the commands that make them
    points: int = 40  # faults that are tried


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of fault."""

    calls: str  # system calls, as strace names them
    fault: str  # what strace does at one of them


@dataclasses.dataclass(frozen=True)
class Point:
    """A fault: at the `when`-th call of a thread."""

    case: str
    kind: str
    when: int


def can_trace() -> str:
    """Return why strace cannot be used here; an empty text if it can."""
    if not shutil.which("strace"):
        return "strace is not installed"
    done = subprocess.run(["strace", "-f", "-o", os.devnull, "true"], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"strace may not trace here: {done.stderr.strip().splitlines()[-1]}"


def run(words: tuple[str, ...], *, cache: pathlib.Path, trace: tuple[str, ...] = ()) -> tuple[int, str]:
    """Run a command of ours, under strace with options `trace` if there are some.

    Args:
      words: program and options.
      cache: folder of compiled programs, of which a killed process may leave half a file.
      trace: options of strace.

    Returns:
      Its exit code, negative for a signal, and what it said on standard error.
    """
    settings = {"XDG_CACHE_HOME": str(cache), "JAX_PLATFORMS": "cpu", "PYTHONDONTWRITEBYTECODE": "1"}
    program = [sys.executable, "-m", PROGRAMS[words[0]], *words[1:]]
    under = ["strace", "-f", "--quiet=all", *trace] if trace else []
    done = subprocess.run(
        [*under, *program], env=os.environ | settings, capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    return done.returncode, done.stderr


def count_calls(
    words: tuple[str, ...], kinds: dict[str, Kind], *, cache: pathlib.Path, log: pathlib.Path
) -> dict[str, int]:
    """Return how many system calls of each kind the busiest thread of a command makes: strace counts by thread."""
    every = ",".join(kind.calls for kind in kinds.values())
    code, said = run(words, cache=cache, trace=(FILTER, "-o", str(log), "-e", f"trace={every}"))
    if code:
        raise UserError(f"{' '.join(words)}: failed without a fault; mend that first: {said.strip()[-300:]}")
    made = collections.Counter(re.findall(r"^(\d+) +(\w+)\(", files.read_text(log), re.MULTILINE))
    found = {}
    for name, kind in kinds.items():
        by_thread = collections.Counter[str]()
        for (thread, call), number in made.items():
            by_thread[thread] += number if call in kind.calls.split(",") else 0
        found[name] = max(by_thread.values(), default=0)
    return found


def attempt(point: Point, case: Case, kind: Kind, whole: Result, *, out: pathlib.Path) -> dict[str, Any]:
    """Try one fault and compare what comes of it with `whole`.

    Args:
      point: the fault.
      case: its command.
      kind: its kind.
      whole: what an undisturbed run has made.
      out: folder of the experiment.

    Returns:
      `reached` (1 if the fault happened), `lost`, `repeated`, `wrong`, `damaged` (between the fault and the second
      run; also of what the command reads), `tracebacks`, and `codes`, the exit codes of both runs.
    """
    work, log = out / "work" / case.name, out / "trace"
    shutil.rmtree(work, ignore_errors=True)
    words = command(case, work, out)
    injected = f"inject={kind.calls}:{kind.fault}:when={point.when}"
    quick = () if "signal" in kind.fault else (FILTER,)
    traced = (*quick, "-o", str(log), "-e", f"trace={kind.calls}", "-e", injected)
    sources = read_by(case, out)
    try:
        code, said = run(words, cache=out / "cache", trace=traced)
        reached = code < 0 or code == 137 or "(INJECTED)" in files.read_text(log)
        torn = faults_found.damaged(work, whole) if work.exists() else []
        torn += sorted({name for name, _ in sources.items() ^ read_by(case, out).items()})
        again, then = run(words, cache=out / "cache")
    except subprocess.TimeoutExpired:
        return {"reached": 1, "lost": 0, "repeated": 0, "wrong": 1, "damaged": 0, "tracebacks": 0, "codes": ["hung"]}
    said += then
    try:
        outcome = faults_found.compare(faults_found.result(work), whole)
    except (UserError, OSError) as error:
        outcome = {"lost": len(whole.records), "repeated": 0, "wrong": 1}
        said += str(error)
    bad_code = again != 0 or (code > 0 and code not in (2, 137))
    found = {
        "reached": int(reached),
        **outcome,
        "damaged": len(torn),
        "tracebacks": said.count("Traceback (most recent call last)"),
        "codes": [code, again],
    }
    found["wrong"] = int(bool(found["wrong"]) or bad_code or read_by(case, out) != sources)
    troubled = any(found[name] for name in ("lost", "repeated", "wrong", "damaged", "tracebacks"))
    return found | ({"said": said[-3000:], "torn": torn} if troubled else {})


def command(case: Case, work: pathlib.Path, out: pathlib.Path) -> tuple[str, ...]:
    """Return the words of a case's command that writes into `work`."""
    return (*(word.replace("{data}", str(out / "data")) for word in case.words), "--out", str(work))


@functools.cache
def reference(case: Case, out: pathlib.Path) -> Result:
    """Return what an undisturbed run makes; it is kept, with the data that it needs and all its programs compiled.

    Raises:
      UserError: one of the commands fails.
    """
    for name, words in case.needs:
        if not any((out / "data" / name / last).exists() for last in ("manifest.json", "part.json")):
            _run_well((*words, "--out", str(out / "data" / name)), out)
    whole, work = out / "whole" / case.name, out / "work" / case.name
    if not whole.exists():
        shutil.rmtree(work, ignore_errors=True)
        _run_well(command(case, work, out), out)
        whole.parent.mkdir(exist_ok=True)
        work.rename(whole)  # an evaluation says in its settings where it was written
    return faults_found.result(whole)


def read_by(case: Case, out: pathlib.Path) -> dict[str, str]:
    """Return the SHA-256 of every file that a command reads, by name: none of them may change."""
    folders = {name: out / "data" / name for name, _ in case.needs}
    return {f"{name}/{file}": sha for name, at in folders.items() for file, sha in faults_found.tree(at).items()}


def _run_well(words: tuple[str, ...], out: pathlib.Path) -> None:
    code, said = run(words, cache=out / "cache")
    if code:
        raise UserError(f"{' '.join(words)}: failed without a fault; mend that first: {said.strip()[-300:]}")
