"""Run a list of commands in order, skipping complete ones; it can be interrupted at any time."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import itertools
import json
import pathlib
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine, typed

PROGRAMS = {
    "dipn-datagen": "dipn_jax.datagen.cli",
    "dipn-train": "dipn_jax.train.cli",
    "dipn-eval": "dipn_jax.eval.cli",
}
"""Module of each of the project's commands; a run's command may also start with any other program."""

STAMP = "stamp.json"
"""File in a run's folder: the command that wrote there, whether it is complete, and with what machines and commits."""

_STAMP = {
    "command": str,
    "key": str,
    "complete": bool,
    "made_by": [{"commit": str, "processor": str, "cores": typed.Maybe(int)}],
    "seed": typed.Maybe(int),
    "versions": {str: str},
}
"""Form of a stamp."""

NOT_RECORDED = "not recorded"
"""What a stamp says of work done in its folder before there was a stamp."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One command and the folder it writes."""

    name: str
    out: pathlib.Path
    command: tuple[str, ...]  # program and arguments, `--out` included

    @property
    def line(self) -> str:
        """The command as one types it in a shell."""
        return shlex.join(self.command)


Part = str | pathlib.Path | Sequence[pathlib.Path]
"""A part of a command: text to be split at spaces, a path, or several paths."""


def words(parts: Iterable[Part]) -> tuple[str, ...]:
    """Return the words of a command: texts are split at spaces, paths are kept whole."""
    found: list[str] = []
    for part in parts:
        if isinstance(part, str):
            found += part.split()
        else:
            found += [str(path) for path in ([part] if isinstance(part, pathlib.Path) else part)]
    return tuple(found)


class Recipe:
    """A list of runs in the making: `run = Recipe(folder)`, then one call per command; each returns its folder."""

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        self.runs: list[Run] = []

    def __call__(self, name: str, *parts: Part, out: pathlib.Path | None = None) -> pathlib.Path:
        """Add a command that writes the folder `name` of the recipe's folder, or `out`.

        Args:
          name: of the run, for the terminal and `--only`.
          parts: program and arguments but `--out`, as `words` takes them.
          out: folder to write, if not the one called `name`.
        """
        place, given = out or self.folder / name, words(parts)
        end = given.index("--") if "--" in given else len(given)  # a command for each training follows
        self.runs.append(Run(name, place, (*given[:end], "--out", str(place), *given[end:])))
        return place

    def borrow(self, others: Sequence[Run], name: str, *, prefix: str) -> pathlib.Path:
        """Add the run `name` of another recipe, with what it needs, as `prefix/NAME`; return the folder it writes."""
        wanted = select(others, [name])
        self.runs += [dataclasses.replace(run, name=f"{prefix}/{run.name}") for run in wanted]
        return wanted[-1].out


def needs(run: Run, others: Sequence[Run]) -> list[Run]:
    """Return the runs before `run` whose folders, or folders in them, its command has among its arguments."""
    places = [place for word in run.command for place in (pathlib.Path(word), *pathlib.Path(word).parents)]
    before = itertools.takewhile(lambda other: other.name != run.name, others)
    return [other for other in before if other.out in places]


def keys(listed: Sequence[Run]) -> dict[str, str]:
    """Return by name of run a digest, in hex, of its command and of the commands of all runs that it needs."""
    found: dict[str, str] = {}
    for run in listed:
        before = [found[other.name] for other in needs(run, listed)]
        found[run.name] = hashlib.sha256(json.dumps([run.command, before]).encode()).hexdigest()
    return found


def named(listed: Sequence[Run], only: Sequence[str]) -> list[str]:
    """Return the names of the runs that `only` names; `changed` stands for all runs called `changed/...`.

    Raises:
      UserError: no run is called so.
    """
    found: list[str] = []
    for wanted in only:
        few = [run.name for run in listed if run.name == wanted or run.name.startswith(f"{wanted}/")]
        if not few:
            raise UserError(f"--only {wanted}: no such run; --list shows their names")
        found += few
    return found


def select(listed: Sequence[Run], only: Sequence[str]) -> list[Run]:
    """Return the runs called `only`, and before them those that they need; all where `only` is empty.

    Args:
      listed: all runs.
      only: names, as `named` takes them.

    Raises:
      UserError: one of the names is none.
    """
    names = {run.name: run for run in listed}
    wanted, waiting = set[str](), named(listed, only) or list(names)
    while waiting:
        name = waiting.pop()
        if name not in wanted:
            wanted.add(name)
            waiting += [other.name for other in needs(names[name], listed)]
    return [run for run in listed if run.name in wanted]


def read_stamp(run: Run) -> dict[str, Any]:
    """Return the stamp in a run's folder; empty where there is none."""
    path = run.out / STAMP
    return files.read_json(path, wanted=_STAMP) if path.exists() else {}


def is_complete(run: Run, key: str) -> bool:
    """Return whether this command, with what it needs, has ended well."""
    stamp = read_stamp(run)
    return stamp.get("key") == key and stamp.get("complete") is True


def write_stamp(run: Run, key: str, *, complete: bool) -> None:
    """Stamp a run's folder; machines and commits that worked there before stay listed."""
    here = {"commit": machine.commit(), "processor": machine.processor(), "cores": machine.cores()}
    made = read_stamp(run).get("made_by", [_before()] if _has_files(run.out) else [])
    stamp = {
        "command": run.line,
        "key": key,
        "complete": complete,
        "made_by": [*made, *([here] if here not in made else [])],
        "seed": _seed(run.out),
        "versions": files.package_versions(),
    }
    files.write_json(run.out / STAMP, stamp)


def _before() -> dict[str, Any]:
    return {"commit": NOT_RECORDED, "processor": NOT_RECORDED, "cores": None}


def _has_files(folder: pathlib.Path) -> bool:
    return folder.is_dir() and any(path.is_file() for path in folder.iterdir())


def _seed(out: pathlib.Path) -> int | None:
    """Return the seed that a data set, a training or an evaluation was made with; None where it has none."""
    for path in (out / "config.json", out / "settings.json"):
        if path.exists() and "seed" in (found := files.read_json(path)):
            return int(found["seed"])
    return None


def carry_out(
    chosen: Sequence[Run], found: dict[str, str], *, after: Callable[[Run, str], None] = lambda run, key: None
) -> int:
    """Carry out the runs in order, up to the first that fails.

    Args:
      chosen: the runs.
      found: their `keys`.
      after: called with each run that is complete, and its key.

    Returns:
      0, or the exit code of the run that failed.
    """
    for number, run in enumerate(chosen, 1):
        title = f"[{number}/{len(chosen)}] {run.name}"
        if is_complete(run, found[run.name]):
            commits = ", ".join(made["commit"] for made in read_stamp(run)["made_by"])
            console.say(f"{title}: complete (commit {commits})")
            after(run, found[run.name])
            continue
        console.say(f"{title}: {run.line}")
        write_stamp(run, found[run.name], complete=False)
        if code := _call(run):
            print(f"error: {run.name} ended with exit code {code}; correct its cause and repeat", file=sys.stderr)
            return code
        write_stamp(run, found[run.name], complete=True)
        after(run, found[run.name])
    return 0


def _call(run: Run) -> int:
    """Run a command and return its exit code.

    The command is in a process group of its own: an interruption reaches us alone and is passed on once, so that the
    command can save its state.

    Raises:
      KeyboardInterrupt: we were interrupted, and the command has ended before its work was done.
    """
    module = PROGRAMS.get(run.command[0])
    program = [sys.executable, "-m", module] if module else [run.command[0]]
    process = subprocess.Popen([*program, *run.command[1:]], process_group=0)
    interrupted = False
    while True:
        try:
            code = process.wait()
            break
        except KeyboardInterrupt:
            interrupted = True
            process.send_signal(signal.SIGINT)
    if interrupted and code:
        raise KeyboardInterrupt
    return 128 - code if code < 0 else code


def parse(run: Run) -> dict[str, Any]:
    """Return the arguments of a run's command as its own parser reads them, without running it.

    Raises:
      UserError: it would not take them. (The parser has printed why.)
    """
    program, *arguments = run.command
    if program not in PROGRAMS:
        return {}
    found: dict[str, Any] = {}
    commands = importlib.import_module(PROGRAMS[program]).COMMANDS

    @functools.wraps(commands[arguments[0]])
    def collect(**values: Any) -> None:
        found.update(values)

    try:
        console.run(program, {**commands, arguments[0]: collect}, arguments)
    except SystemExit:
        raise UserError(f"{run.name}: {program} does not take these arguments: {run.line}") from None
    if "--" in arguments:  # the command of each training of a sweep
        training = (program, *arguments[arguments.index("--") + 1 :], "--out", str(run.out / "one"))
        parse(dataclasses.replace(run, command=training))
    return found
