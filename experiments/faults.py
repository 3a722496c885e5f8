"""Faults: kill small commands, or fill their disk, at one system call after another; then give the command again.

    python -m experiments.faults                              # 200 faults: about an hour on 2 cores
    python -m experiments.faults --only generate --points 20  # fewer
    python -m experiments.faults --list                       # the commands and the kinds of faults

It needs strace, and leave to trace. What comes of a fault and a second run is compared with an undisturbed run: records
lost or repeated, results that differ. Interrupted, the same command continues. `docs/reliability.json` and the tables
of `docs/reliability.md` have the counts.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import pathlib
import shutil
import sys
from collections.abc import Collection, Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine
from experiments import faults_run, pages, reliability
from experiments.faults_run import Case, Kind, Point
from experiments.mutants_session import ROOT, STAGES

_FEW = ("--objects", "1:2", "--engine", "native", "--threads", "1")
_BRIEF = ("--steps", "4", "--batch", "2", "--eval-every", "2", "--save-every", "2")
_PUSHES = ("dipn-datagen", "push", "--episodes", "24", "--shard-size", "24", *_FEW)
_GRASPS = ("dipn-datagen", "grasp", "--episodes", "24", "--shard-size", "24", *_FEW)
CASES = (
    Case("generate", ("dipn-datagen", "push", "--episodes", "8", "--shard-size", "1", "--actions", "1", *_FEW)),
    Case("push", ("dipn-train", "push", "--data", "{data}/push", *_BRIEF), (_PUSHES,)),
    Case("grasp", ("dipn-train", "grasp", "--data", "{data}/grasp", *_BRIEF), (_GRASPS,)),
    Case(
        "baseline",
        (
            *("dipn-train", "baseline", "--method", "rea", "--actions", "4", "--tables", "2", "--updates", "1"),
            *("--batch", "2", *_FEW),
        ),
    ),
    Case(
        "clear",
        (
            *("dipn-eval", "clear", "--method", "gn", "--grasp-net", "builtin", "--cases", "random"),
            *("--instances", "2", *_FEW),
        ),
    ),
)
"""The commands that are disturbed."""
KINDS = {
    "killed at a rename": Kind("rename,renameat,renameat2", "signal=SIGKILL"),
    "killed at a write": Kind("write,pwrite64,writev", "signal=SIGKILL"),
    "killed at a sync": Kind("fsync,fdatasync", "signal=SIGKILL"),
    "disk full at a sync": Kind("fsync,fdatasync", "error=ENOSPC"),
}
"""The kinds of faults."""
POINTS = 200
"""Faults that are tried."""
NEARER = (0.75, 0.5, 0.25)
"""A fault that is not reached, since another thread makes the call this time, is tried at these parts of the way."""
COUNTED = ("lost", "repeated", "wrong", "damaged", "tracebacks")
"""What is added up over faults."""


def spread(counts: dict[tuple[str, str], int], total: int) -> list[Point]:
    """Return faults spread evenly over the calls of every command and kind, so that also the first few are.

    Args:
      counts: calls that can be disturbed, by case and kind.
      total: number of faults at most.
    """
    share = dict.fromkeys(counts, 0)
    while sum(share.values()) < total and any(share[key] < counts[key] for key in counts):
        for key in counts:
            if share[key] < counts[key] and sum(share.values()) < total:
                share[key] += 1
    chosen: list[tuple[int, Point]] = []
    for (case, kind), number in share.items():
        calls = [1 + round(i * (counts[case, kind] - 1) / max(number - 1, 1)) for i in range(number)]
        calls.sort(key=lambda when: (when * 0.618034) % 1)
        chosen += [(rank, Point(case, kind, when)) for rank, when in enumerate(calls)]
    return [point for _, point in sorted(chosen, key=lambda each: each[0])]


def count(cases: Sequence[Case], out: pathlib.Path, code: str) -> dict[tuple[str, str], int]:
    """Return the calls that can be disturbed by case and kind; counted once for these sources."""
    path = out / "calls.json"
    kept = files.read_json(path) if path.exists() else {}
    if kept.get("code") != code:
        kept = {"code": code}
        shutil.rmtree(out / "whole", ignore_errors=True)
    for case in cases:
        if case.name not in kept:
            faults_run.reference(case, out)
            work = out / "work" / case.name
            shutil.rmtree(work, ignore_errors=True)
            words = faults_run.command(case, work, out)
            kept[case.name] = faults_run.count_calls(words, KINDS, cache=out / "cache", log=out / "trace")
            files.write_json(path, kept)
    return {(case.name, name): kept[case.name][name] for case in cases for name in KINDS}


def summary(tried: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the counts by command and kind, from what `faults_run.attempt` found of each point."""
    found: dict[str, Any] = {}
    for each in tried:
        row = found.setdefault(each["case"], {}).setdefault(each["kind"], dict.fromkeys(("tried", *COUNTED), 0))
        row["tried"] += each["reached"]
        for name in COUNTED:
            row[name] += each[name]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [case.name for case in CASES]
    parser.add_argument("--list", action="store_true", help="show the commands and the kinds of faults")
    parser.add_argument("--dry-run", action="store_true", help="as --list")
    parser.add_argument("--only", nargs="+", default=names, choices=names, metavar="NAME", help="these commands")
    parser.add_argument("--points", type=int, default=POINTS, metavar="N", help=f"faults in all (default: {POINTS})")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("results/faults"), metavar="FOLDER")
    options = parser.parse_args(arguments)
    return console.exit_code(lambda: _work(options))


def _work(options: argparse.Namespace) -> int:
    cases = [case for case in CASES if case.name in options.only]
    if options.list or options.dry_run:
        for case in cases:
            console.say(f"{case.name}: {' '.join(case.words)}")
        for name, kind in KINDS.items():
            console.say(f"{name}: {kind.calls}:{kind.fault}")
        return 0
    console.require_positive(points=options.points)
    console.require_out(options.out)
    if reason := faults_run.can_trace():
        raise UserError(f"faults: {reason}; install strace, and run where processes may be traced")
    console.enable_compilation_cache()
    out = options.out.resolve()
    (out / "points").mkdir(parents=True, exist_ok=True)
    code = files.code_digest(*(ROOT / stage for stage in STAGES))
    by_name = {case.name: case for case in cases}
    points = spread(count(cases, out, code), POINTS)[: options.points]
    with console.Progress("faults", len(points), unit="faults") as progress:
        for point in points:
            _try(point, by_name[point.case], out, code, listed=points)
            _write_page(out, code)
            progress.advance(1)
    return 0


def _write_page(out: pathlib.Path, code: str) -> None:
    """Write what has been found with these sources so far, also of other commands, to the page."""
    tried = [files.read_json(path) for path in sorted((out / "points").glob("*.json"))]
    found = summary([each for each in tried if each["code"] == code])
    made = {"commit": machine.commit(), "processor": machine.processor()}
    reliability.write("faults", found | {pages.MADE: made})


def nearer(point: Point, taken: Collection[Point]) -> list[Point]:
    """Return earlier faults to try in turn if `point` is not reached; none of them is in `taken`."""
    found: list[Point] = []
    for part in NEARER:
        calls = range(math.ceil(part * point.when), 0, -1)
        free = (dataclasses.replace(point, when=when) for when in calls)
        found += [next((each for each in free if each not in taken and each not in found), point)]
    return [each for each in found if each != point]


def _try(point: Point, case: Case, out: pathlib.Path, code: str, *, listed: Collection[Point]) -> None:
    """Try one fault, unless that has been done with these sources; `listed` are all that are to be tried."""
    path = out / "points" / f"{point.case}-{point.kind.replace(' ', '_')}-{point.when:04d}.json"
    if path.exists() and files.read_json(path)["code"] == code:
        return
    tried = [files.read_json(each) for each in (out / "points").glob(f"{point.case}-*.json")]
    taken = {*listed, *(Point(each["case"], each["kind"], each["when"]) for each in tried if each["code"] == code)}
    whole, sums = faults_run.reference(case, out), dict.fromkeys(COUNTED, 0)
    for each in (point, *nearer(point, taken)):
        found = faults_run.attempt(each, case, KINDS[point.kind], whole, out=out)
        sums = {name: sums[name] + found[name] for name in COUNTED}  # also of those that were not reached
        if found["reached"]:
            break
    about = {"case": point.case, "kind": point.kind, "when": each.when, "code": code}
    files.write_json(path, about | found | sums)
    if any(found[name] for name in COUNTED):
        console.say(json.dumps(about | {name: found[name] for name in (*COUNTED, "codes")}))


if __name__ == "__main__":
    sys.exit(main())
