"""One fault: a small command under strace, which kills it or fills its disk at one system call, then the same again."""

from __future__ import annotations

import collections
import dataclasses
import functools
import hashlib
import os
import pathlib
import re
import shutil
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.storage import checkpoint, records
from dipn_jax.system import files
from experiments.runs import PROGRAMS

FILTER = "--seccomp-bpf"
"""Option by which strace stops a process at the calls that it traces only; it then sends no signals (version 6.1)."""
PATIENCE = 300.0
"""Seconds after which a command counts as hung."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A small command whose faults are tried."""

    name: str
    words: tuple[str, ...]  # `{data}` stands for the folder of data sets
    needs: tuple[tuple[str, ...], ...] = ()  # commands that make those


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


@dataclasses.dataclass(frozen=True)
class Result:
    """What a command has made: its records, in order, and a digest of every result that must not differ."""

    records: list[str]
    digests: dict[str, str]


def result(out: pathlib.Path) -> Result:
    """Return what a finished command has made in a folder: a data set, a run or an evaluation.

    Raises:
      UserError: something in it is damaged.
    """
    if (out / "manifest.json").exists():
        episodes, _ = records.load(out, kind="push")
        rows = [structs.take(episodes, i) for i in range(len(episodes.fault))]
        names = ("config.json", "manifest.json", *(path.name for path in out.glob("shard-*")))
        return Result([_digest(row) for row in rows], {name: files.file_sha256(out / name) for name in names})
    if (out / "checkpoints").exists():
        found = checkpoint.newest(out)
        if found is None:
            raise UserError(f"{out}: no whole step")
        folder, meta = found
        arrays = {name: _digest(arrays_of(folder / name)) for name in ("model", "train") if (folder / name).exists()}
        lines = files.read_text(out / "metrics.jsonl").splitlines()
        plain = {key: value for key, value in meta.items() if key != "sha256"}
        return Result(lines, arrays | {"meta": repr(sorted(plain.items())), "metrics": "\n".join(lines)})
    entries = files.read_json(out / "episodes.json", wanted=list)
    names = ("metrics.json", "settings.json", "episodes.json", *(entry["file"] for entry in entries))
    return Result([repr(entry) for entry in entries], {name: files.file_sha256(out / name) for name in names})


def arrays_of(part: pathlib.Path) -> dict[str, np.ndarray]:
    """Return the arrays of one part of a step, `STEP/model` or `STEP/train`, by their names in the order of these."""
    checkpointer = ocp.PyTreeCheckpointer()
    names = sorted(checkpointer.metadata(part.resolve()).item_metadata.tree)
    as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in names}
    found = checkpointer.restore(part.resolve(), restore_args=as_numpy)
    return {name: found[name] for name in names}


def _digest(tree: Any) -> str:
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()


def damaged(out: pathlib.Path, whole: Result) -> list[str]:
    """Return what has its final name after a fault, and is not as an undisturbed run makes it or cannot be read."""
    wrong = []
    for name in whole.digests:
        path = out / name
        written_once = name.endswith((".parquet", ".npz")) or name == "metrics.json"
        if written_once and path.exists() and files.file_sha256(path) != whole.digests[name]:
            wrong.append(name)
    for path in [*out.glob("*.json")]:
        if not path.name.startswith("owner"):
            try:
                files.read_json(path, wanted=object)
            except UserError:
                wrong.append(path.name)
    steps = out / "checkpoints"
    for folder in steps.iterdir() if steps.is_dir() else []:
        if folder.name.isdigit() and checkpoint.newest(folder) is None:
            wrong.append(f"checkpoints/{folder.name}")
    return wrong


def compare(found: Result, whole: Result) -> dict[str, int]:
    """Return how many records are lost and repeated, and whether anything differs from an undisturbed run's."""
    here, there = collections.Counter(found.records), collections.Counter(whole.records)
    repeated = sum(max(0, here[record] - there[record]) for record in here if record in there)
    wrong = found.digests != whole.digests
    return {"lost": (there - here).total(), "repeated": repeated, "wrong": int(wrong)}


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
      run), `tracebacks`, and `codes`, the exit codes of both runs.
    """
    work, log = out / "work" / case.name, out / "trace"
    shutil.rmtree(work, ignore_errors=True)
    words = command(case, work, out)
    injected = f"inject={kind.calls}:{kind.fault}:when={point.when}"
    quick = () if "signal" in kind.fault else (FILTER,)
    traced = (*quick, "-o", str(log), "-e", f"trace={kind.calls}", "-e", injected)
    try:
        code, said = run(words, cache=out / "cache", trace=traced)
        reached = code < 0 or code == 137 or "(INJECTED)" in files.read_text(log)
        torn = damaged(work, whole) if work.exists() else []
        again, then = run(words, cache=out / "cache")
    except subprocess.TimeoutExpired:
        return {"reached": 1, "lost": 0, "repeated": 0, "wrong": 1, "damaged": 0, "tracebacks": 0, "codes": ["hung"]}
    said += then
    try:
        outcome = compare(result(work), whole)
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
    found["wrong"] = int(bool(found["wrong"]) or bad_code)
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
    for words in case.needs:
        if not (out / "data" / words[1] / "manifest.json").exists():
            _run_well((*words, "--out", str(out / "data" / words[1])), out)
    whole, work = out / "whole" / case.name, out / "work" / case.name
    if not whole.exists():
        shutil.rmtree(work, ignore_errors=True)
        _run_well(command(case, work, out), out)
        whole.parent.mkdir(exist_ok=True)
        work.rename(whole)  # an evaluation says in its settings where it was written
    return result(whole)


def _run_well(words: tuple[str, ...], out: pathlib.Path) -> None:
    code, said = run(words, cache=out / "cache")
    if code:
        raise UserError(f"{' '.join(words)}: failed without a fault; mend that first: {said.strip()[-300:]}")
