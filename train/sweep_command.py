"""The command `dipn-train sweep`: one training for each of several seeds and limits. Importing this imports no JAX."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import pathlib
import shlex
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from dipn_jax.commands import command_line, console
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError
from dipn_jax.system import files, typed

from .sweeping import Training

RECORD = "sweep.json"
"""Name of the file with the trainings and what they measured, in the folder of them all."""
_TRAINING = {
    "seed": typed.Whole(),
    "limit": typed.Maybe(typed.Whole(1)),
    "steps?": typed.Maybe(typed.Whole(1)),
    "values": typed.Maybe({str: float}),
}
_FORM = {"command": [str], "trainings": {str: _TRAINING}}
_UNCOMPARED_OPTIONS = ("out", "seed", "limit", "threads", "memory", "data_parallel", "profile")
"""Options that differ between trainings, or on which no result depends."""


def sweep(
    command: tyro.conf.Positional[tuple[str, ...]],
    out: pathlib.Path,
    seeds: tuple[int, ...] = (0,),
    limits: tuple[int, ...] = (),
    steps: tuple[int, ...] = (),
    at_once: int = 1,
    launch: Annotated[Launch, tyro.conf.arg(name="")] = LOCAL,
) -> None:
    """Train with each of several seeds, on each of several numbers of episodes, and list what was measured.

    The command of a training, without --out and --seed, stands after --:
      dipn-train sweep --seeds 0 1 2 --limits 500 1500 --out runs/curve -- push --data data/push --steps 3000

    Each training is a run of its own, in OUT/LIMIT-SEED or OUT/seed-SEED. The same command continues those
    that were stopped and skips those that have ended; seeds and limits may be added.

    Args:
      command: push, grasp-pretrain, grasp, grasp-online or baseline, and its options.
      out: folder for the runs and sweep.json, the last values in the metrics.jsonl of each.
      seeds: seeds; all limits of one are trained before the next.
      limits: numbers of the first episodes of --data that push or grasp learn from; what is held out stays the same.
      steps: optimizer steps with each of --limits, in their order; if not given, all make those of --steps after --.
      at_once: trainings at a time, where they are launched locally.
      launch: where trainings run, each in a process of its own.
    """
    console.require_out(out)
    console.require_between(1, 1024, at_once=at_once)
    if launch.uses_cluster and at_once != 1:
        raise UserError("--at-once: for --launcher local; ray runs as many trainings as the cluster has room for")
    from dipn_jax.storage import owner

    from . import sweeping

    trainings = plan(command, out, seeds=seeds, limits=limits, steps=steps)
    with owner.owned(out):
        record = _record(out, trainings, own_steps=bool(steps))
        listed = record["trainings"]
        todo = [each for each in trainings if listed[each.name]["values"] is None or not each.given["out"].is_dir()]
        sweeping.check(todo)
        files.write_json(out / RECORD, record)
        run = sweeping.on_cluster(todo, where=launch) if launch.uses_cluster else sweeping.here(todo, at_once=at_once)
        with contextlib.closing(run):
            for done, (number, values) in enumerate(run, len(trainings) - len(todo) + 1):
                listed[todo[number].name]["values"] = values
                files.write_json(out / RECORD, record)
                said = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
                console.say(f"[{done}/{len(trainings)}] {todo[number].name}: {said}")
    for line in table({each.name: listed[each.name]["values"] for each in trainings}):
        console.say(line)


def plan(
    command: Sequence[str], out: pathlib.Path, *, seeds: Sequence[int], limits: Sequence[int], steps: Sequence[int] = ()
) -> list[Training]:
    """Return the trainings, in order.

    Args:
      command: of one of them, without `--out` and `--seed`.
      out: folder of them all.
      seeds: of the trainings.
      limits: numbers of episodes learnt from; none: the command says it.
      steps: optimizer steps with each limit; none: the command says it.

    Raises:
      UserError: the command is none that trains, or seeds, limits or steps make no sense.
    """
    kind, given = _parsed(command, out)
    for name, values in (("seeds", seeds), ("limits", limits)):
        if len(set(values)) < len(values):
            raise UserError(f"--{name} {' '.join(map(str, values))}: want none twice")
    if not seeds:
        raise UserError("--seeds: want at least one")
    if limits and "limit" not in given:
        raise UserError(f"--limits: dipn-train {kind} takes no --limit; give push or grasp, or seeds only")
    if limits and given["limit"] is not None:
        raise UserError(f"--limits, and --limit {given['limit']} after --: give one of them")
    _check_steps(command, limits=limits, steps=steps)
    for seed in seeds:
        console.require_seed(seed)
    compute = given.get("compute")
    if compute and (compute.compile_only or compute.check_only or compute.coordinator or compute.processes != 1):
        raise UserError("sweep: a training is one process that trains; leave out --compile-only and --coordinator")
    trainings = []
    for seed in seeds:
        for number, limit in enumerate(limits or (given.get("limit"),)):
            name = f"seed-{seed}" if limit is None else f"{limit}-{seed}"
            config = {"seed": seed} | ({"steps": steps[number]} if steps else {})
            own = {"out": out / name, "config": dataclasses.replace(given["config"], **config)}
            own |= {"limit": limit} if limits else {}
            trainings.append(Training(name, kind, given | own, seed, limit))
    return trainings


def _check_steps(command: Sequence[str], *, limits: Sequence[int], steps: Sequence[int]) -> None:
    """Raise an error unless there are steps for every limit, or none at all.

    Raises:
      UserError: there are not, one is below 1, or the command says how many, too.
    """
    said = f"--steps {' '.join(map(str, steps))}"
    if steps and len(steps) != len(limits):
        raise UserError(f"{said}: {len(steps)} for {len(limits)} of --limits; give one for each, in their order")
    if steps and min(steps) < 1:
        raise UserError(f"{said}: want whole numbers from 1 on")
    if steps and any(word.partition("=")[0] == "--steps" for word in command):
        raise UserError(f"{said}, and --steps after --; give one of them")


def _parsed(command: Sequence[str], out: pathlib.Path) -> tuple[str, dict[str, Any]]:
    """Return which command of dipn-train is given, and its arguments by name, without calling it."""
    from . import cli

    commands: dict[str, Any] = cli.COMMANDS
    kinds = {name: each for name, each in commands.items() if "config" in inspect.signature(each).parameters}
    if not command or command[0] not in kinds:
        got = typed.one_line(command[0]) if command else "nothing"
        raise UserError(f"sweep: {got} after --; want the command of a training, one of {', '.join(kinds)}")
    if twice := [word for word in command if word.partition("=")[0] in ("--out", "--seed")]:
        raise UserError(f"sweep: {twice[0]} after --; give --out and --seeds before it")
    given: dict[str, Any] = {}
    kinds[command[0]] = functools.wraps(kinds[command[0]])(lambda **arguments: given.update(arguments))
    if code := console.run("Train networks.", kinds, [*command, "--out", str(out)]):
        raise SystemExit(code)  # it has said why
    return command[0], given


def _record(out: pathlib.Path, trainings: Sequence[Training], *, own_steps: bool) -> dict[str, Any]:
    """Return the content of `sweep.json`: all trainings, those in the present file with what they measured.

    Where each limit has its own steps (`own_steps`), one that made another number of them has measured nothing yet.

    Raises:
      UserError: it is damaged, or those there are of another command.
    """
    from . import cli

    first = trainings[0]
    commands: dict[str, Any] = cli.COMMANDS
    free = (*_UNCOMPARED_OPTIONS, "steps") if own_steps else _UNCOMPARED_OPTIONS
    command = [first.kind, *command_line.words(commands[first.kind], first.given, without=free)]
    path = out / RECORD
    record: dict[str, Any] = {"command": command, "trainings": {}}
    record = files.read_json(path, wanted=_FORM) if path.exists() else record
    if record["command"] != command:
        theirs = shlex.join(["dipn-train", *record["command"]])
        raise UserError(f"{out}: has trainings by `{theirs}`; give that, or another --out")
    for each in trainings:
        new = {"seed": each.seed, "limit": each.limit, "values": None}
        new |= {"steps": each.given["config"].steps} if own_steps else {}
        known = record["trainings"].get(each.name, new)
        record["trainings"][each.name] = known if known.get("steps") == new.get("steps") else new
    return record


def table(values: dict[str, dict[str, float]]) -> list[str]:
    """Return the lines of a table of what each training measured last, by its name."""
    names = list(dict.fromkeys(name for found in values.values() for name in found))
    rows = [["training", *names]]
    rows += [[key, *(f"{found[name]:.4g}" if name in found else "" for name in names)] for key, found in values.items()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.rjust, row, widths)).rstrip() for row in rows]
