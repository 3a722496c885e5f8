"""Faults: kill small commands, or fill their disk, at one system call after another; then give the command again.

    python -m experiments.faults                              # all: two to three hours on 2 cores
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
from experiments import faults_run, reliability
from experiments.faults_run import Case, Kind, Point
from experiments.mutants_session import ROOT, STAGES

_SMALL_SCENES = ("--objects", "1:2", "--engine", "native", "--threads", "1")
_SHORT_TRAINING = ("--steps", "4", "--batch", "2", "--eval-every", "2", "--save-every", "2")
_ACTING = ("--tables", "2", "--updates", "1", "--batch", "2", *_SMALL_SCENES)
_PUSHES = ("push", ("dipn-datagen", "push", "--episodes", "24", "--shard-size", "24", *_SMALL_SCENES))
_GRASPS = ("grasp", ("dipn-datagen", "grasp", "--episodes", "24", "--shard-size", "24", *_SMALL_SCENES))
_IMAGES = ("images", ("dipn-datagen", "images", "--episodes", "24", "--shard-size", "24", *_SMALL_SCENES))
_SHARDS = ("dipn-datagen", "push", "--shard-size", "2", "--actions", "1", *_SMALL_SCENES)
_ONE = ("one", (*_SHARDS, "--episodes", "8"))
_OTHER = ("other", (*_SHARDS, "--episodes", "4", "--seed", "1"))
_CLEAR = ("dipn-eval", "clear", "--method", "gn", "--grasp-net", "builtin", "--cases", "random", *_SMALL_SCENES)
_PREDICT = ("dipn-eval", "prediction", "--push-net", "builtin", "--no-segmented", "--no-physics", *_SMALL_SCENES)
_BASELINE = ("dipn-train", "baseline", "--actions", "4", *_ACTING)


def _part(number: int) -> tuple[str, ...]:
    """Return the options of one of two workers."""
    return ("--shard", str(number), "--of", "2")


_CLEARED = tuple((f"clear-{i}", (*_CLEAR, "--instances", "4", *_part(i))) for i in range(2))
_PREDICTED = tuple((f"prediction-{i}", (*_PREDICT, "--scenes", "65", *_part(i))) for i in range(2))
CASES = (
    Case(
        "generate", ("dipn-datagen", "push", "--episodes", "8", "--shard-size", "1", "--actions", "1", *_SMALL_SCENES)
    ),
    Case("push", ("dipn-train", "push", "--data", "{data}/push", *_SHORT_TRAINING), (_PUSHES,)),
    Case("grasp", ("dipn-train", "grasp", "--data", "{data}/grasp", *_SHORT_TRAINING), (_GRASPS,)),
    Case("baseline", (*_BASELINE, "--method", "rea")),
    Case("clear", (*_CLEAR, "--instances", "2")),
    Case("merge", ("dipn-datagen", "merge", "{data}/one", "{data}/other"), (_ONE, _OTHER), points=12),
    Case("export", ("dipn-datagen", "export", "{data}/one"), (_ONE,), points=8),
    Case("export-zarr", ("dipn-datagen", "export", "{data}/one", "--format", "zarr"), (_ONE,), points=8),
    Case("export-lerobot", ("dipn-datagen", "export", "{data}/one", "--format", "lerobot"), (_ONE,), points=8),
    Case("clear-part", (*_CLEAR, "--instances", "4", *_part(0)), points=8),
    Case("prediction-part", (*_PREDICT, "--scenes", "129", *_part(0)), points=4),
    Case("clear-merge", ("dipn-eval", "merge", "{data}/clear-0", "{data}/clear-1"), _CLEARED, points=8),
    Case(
        "prediction-merge", ("dipn-eval", "merge", "{data}/prediction-0", "{data}/prediction-1"), _PREDICTED, points=8
    ),
    Case(
        "push-files",
        ("dipn-train", "push", "--data", "{data}/push", "--memory", "0", *_SHORT_TRAINING),
        (_PUSHES,),
        points=8,
    ),
    Case(
        "grasp-pretrain",
        ("dipn-train", "grasp-pretrain", "--data", "{data}/images", *_SHORT_TRAINING),
        (_IMAGES,),
        points=4,
    ),
    Case("grasp-online", ("dipn-train", "grasp-online", "--init", "builtin", "--grasps", "4", *_ACTING), points=8),
    Case("vpg", (*_BASELINE, "--method", "vpg"), points=4),
    Case("dqn", (*_BASELINE, "--method", "dqn", "--grasp-net", "builtin"), points=4),
)
"""The commands that are disturbed."""
KINDS = {
    "killed at a rename": Kind("rename,renameat,renameat2", "signal=SIGKILL"),
    "killed at a write": Kind("write,pwrite64,writev", "signal=SIGKILL"),
    "killed at a sync": Kind("fsync,fdatasync", "signal=SIGKILL"),
    "disk full at a sync": Kind("fsync,fdatasync", "error=ENOSPC"),
}
"""The kinds of faults."""
POINTS = sum(case.points for case in CASES)
"""Faults that are tried."""
FIRST_AND_LAST = 3
"""Faults of a kind from which on the first and the last call are among them; fewer are in the midst."""
NEARER = (0.75, 0.5, 0.25)
"""A fault that is not reached, since another thread makes the call this time, is tried at these parts of the way."""
COUNTED = ("lost", "repeated", "wrong", "damaged", "tracebacks")
"""What is added up over faults."""


def spread(counts: dict[tuple[str, str], int], totals: dict[str, int]) -> list[Point]:
    """Return faults spread evenly over the calls of every kind of each command, so that also the first few are.

    Args:
      counts: calls that can be disturbed, by case and kind.
      totals: number of faults at most, by case.
    """
    share = dict.fromkeys(counts, 0)
    for case, total in totals.items():
        open_to = [key for key in counts if key[0] == case]
        while sum(share[key] for key in open_to) < total and any(share[key] < counts[key] for key in open_to):
            for key in open_to:
                if share[key] < counts[key] and sum(share[each] for each in open_to) < total:
                    share[key] += 1
    chosen: list[tuple[int, Point]] = []
    for (case, kind), number in share.items():
        calls = _calls(number, counts[case, kind])
        chosen += [(rank, Point(case, kind, when)) for rank, when in enumerate(calls)]
    return [point for _, point in sorted(chosen, key=lambda each: each[0])]


def _calls(number: int, most: int) -> list[int]:
    """Return `number` different calls, of `most`, evenly apart, in an order in which also the first few are."""
    if number < FIRST_AND_LAST:
        return [1 + int((i + 0.5) * most / number) for i in range(number)]
    calls = [1 + round(i * (most - 1) / (number - 1)) for i in range(number)]
    return sorted(calls, key=lambda when: (when * 0.618034) % 1)


def count(cases: Sequence[Case], out: pathlib.Path, code: str) -> dict[tuple[str, str], int]:
    """Return the calls that can be disturbed by case and kind; counted once for these sources."""
    path = out / "calls.json"
    kept = files.read_json(path) if path.exists() else {}
    if kept.get("code") != code:
        kept = {"code": code}
        for folder in ("whole", "data"):
            shutil.rmtree(out / folder, ignore_errors=True)
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
    totals = {case.name: case.points for case in cases}
    points = spread(count(cases, out, code), totals)[: options.points]
    with console.Progress("faults", len(points), unit="faults") as progress:
        for point in points:
            _try(point, by_name[point.case], out, code, listed=points)
            _write_page(out, code)
            progress.advance(1)
    return 0


def _write_page(out: pathlib.Path, code: str) -> None:
    """Write what has been found with these sources so far to the page; what it says of other commands stays."""
    tried = [files.read_json(path) for path in sorted((out / "points").glob("*.json"))]
    found = summary([each for each in tried if each["code"] == code])
    made = {"commit": machine.commit(), "processor": machine.processor()}
    reliability.write_faults(found, made, known=[case.name for case in CASES])


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
