"""Several trainings, each in a process of its own: on this machine, or as tasks of a cluster. Imports no JAX."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import pathlib
import subprocess
import sys
import threading
from collections.abc import Generator, Iterable, Sequence
from typing import Any

from dipn_jax.commands import command_line, console, launch
from dipn_jax.commands.launch import RETRIES, Launch
from dipn_jax.errors import UserError
from dipn_jax.system import files

Values = dict[str, float]
"""What a run measured last."""
_INTERRUPTED = 130
"""Exit code of a training that was asked to stop."""


@dataclasses.dataclass(frozen=True)
class Training:
    """One of the trainings."""

    name: str
    kind: str  # command of dipn-train
    given: dict[str, Any]  # its arguments by name, paths absolute
    seed: int
    limit: int | None

    def words(self) -> list[str]:
        """Return the words of its command, after `dipn-train`."""
        from . import cli

        commands: dict[str, Any] = cli.COMMANDS
        return [self.kind, *command_line.words(commands[self.kind], self.given)]


def check(trainings: Iterable[Training]) -> None:
    """Raise an error unless the trainings can begin; those that learn while they act have no data to check.

    Raises:
      UserError: an option, the data or a folder is wrong.
    """
    commands = [[*each.words(), "--check-only"] for each in trainings if "compute" in each.given]
    if commands:
        code, error = _call(commands, "check", _Children())
        if code == _INTERRUPTED:
            raise KeyboardInterrupt
        if code:
            raise UserError(error or f"the trainings cannot be checked: their process ended with exit code {code}")


def last(run: pathlib.Path) -> Values:
    """Return what a run measured last."""
    lines = files.read_lines(run / "metrics.jsonl", wanted={str: float})
    return lines[-1] if lines else {}


def train(kind: str, given: dict[str, Any]) -> Values:
    """Train, or continue a training, and return its last measurements. Runs as a Ray task, so it may be retried.

    Args:
      kind: command of dipn-train.
      given: its options by name, as its function takes them; a dictionary, because each command has its own options.
    """
    from . import cli

    commands: dict[str, Any] = cli.COMMANDS
    commands[kind](**given)
    return last(given["out"])


def on_cluster(todo: Sequence[Training], *, where: Launch) -> Generator[tuple[int, Values], None, None]:
    """Train as tasks of a cluster; yield number and values of each training as it ends."""
    tasks = []
    for each in todo:
        threads = {"threads": where.threads(each.given["threads"])} if "threads" in each.given else {}
        tasks.append((each.kind, each.given | threads))
    return launch.run(train, tasks, launch=where, fresh=True)


def here(todo: Sequence[Training], *, at_once: int) -> Generator[tuple[int, Values], None, None]:
    """Train in processes of this machine; yield number and values of each training as it ends.

    Where it is closed, or one cannot continue, the others save their state and stop first.

    Args:
      todo: the trainings.
      at_once: number of processes at a time.

    Raises:
      UserError: a training raised it, or its process was killed each time.
    """
    children = _Children()
    with concurrent.futures.ThreadPoolExecutor(at_once) as pool:
        numbers = {pool.submit(_train_alone, each, children): number for number, each in enumerate(todo)}
        try:
            for ended in concurrent.futures.as_completed(numbers):
                yield numbers[ended], ended.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            children.stop()


def _train_alone(training: Training, children: _Children) -> Values:
    """Train in a process; if killed it is started again, up to RETRIES times, and continues from its last step."""
    for _ in range(RETRIES + 1):
        code, error = _call([training.words()], training.name, children)
        if children.stopped:
            raise concurrent.futures.CancelledError
        if code == 0:
            return last(training.given["out"])
        if code > 0 and code != _INTERRUPTED:
            raise UserError(error or f"{training.name}: ended with exit code {code}, for the reason above")
        console.note(f"{training.name}: its process was killed ({code}); continues from its last checkpoint")
    raise UserError(f"{training.name}: its process was killed {RETRIES + 1} times, often for memory; see --at-once")


class _Children:
    """The processes of trainings, which run until they end or are asked to stop."""

    def __init__(self) -> None:
        self.stopped = False
        self._going: set[subprocess.Popen[str]] = set()
        self._lock = threading.Lock()

    def begin(self, program: Sequence[str]) -> subprocess.Popen[str]:
        """Start a process in a group of its own, so that an interruption at the terminal reaches us alone.

        Raises:
          CancelledError: processes have been asked to stop.
        """
        with self._lock:
            if self.stopped:
                raise concurrent.futures.CancelledError
            process = subprocess.Popen(
                program,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
                process_group=0,
            )
            self._going.add(process)
        return process

    def end(self, process: subprocess.Popen[str]) -> None:
        """Forget a process."""
        with self._lock:
            self._going.discard(process)

    def stop(self) -> None:
        """Ask all processes to stop by closing their input, which `child_process` watches."""
        with self._lock:
            self.stopped = True
            for process in self._going:
                assert process.stdin
                process.stdin.close()


def _program(commands: Sequence[Sequence[str]]) -> list[str]:
    """Return the command line of a process that carries out commands of `dipn-train`, one after another."""
    return [sys.executable, "-m", f"{__package__}.child_process", json.dumps(commands)]


def _call(commands: Sequence[Sequence[str]], title: str, children: _Children) -> tuple[int, str]:
    """Carry out commands in a process, whose lines are shown behind `title`.

    Returns:
      Its exit code, and what it says of a mistake of the user's.
    """
    error = ""
    with children.begin(_program(commands)) as process:
        assert process.stderr
        for line in map(str.rstrip, process.stderr):
            if line.startswith("error: "):
                error = line.removeprefix("error: ")
            elif not line.startswith("interrupted: "):
                console.note(f"{title}: {line}")
        process.wait()
        children.end(process)
    return process.returncode, error
