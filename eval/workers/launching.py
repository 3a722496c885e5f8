"""Parts of an evaluation as tasks of a cluster, which are then put together. Imports no JAX at the top."""

from __future__ import annotations

import contextlib
import pathlib
import shutil
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dipn_jax.commands import console, launch
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.system import files, temporary

from .. import options
from . import merging, shares
from .shares import PART, Share

if TYPE_CHECKING:
    from dipn_jax.storage import resume

PARTS_FOLDER = "parts"
"""Name of the folder with the parts, in that of the evaluation."""


def evaluate(kind: str, asked: Mapping[str, Any], partial: resume.Partial, *, total: int) -> None:
    """Make the parts of an evaluation that are missing, and put all together.

    Args:
      kind: command of dipn-eval.
      asked: its arguments by name, `share` and `launch` among them.
      partial: of the whole evaluation.
      total: number of tables, or of groups of pushes, that the parts share.

    Raises:
      UserError: there are more parts than that; there is a part of another evaluation; or a task raised it.
    """
    from dipn_jax.storage import owner

    asked["share"].rows(total)  # raises before anything is launched
    out: pathlib.Path = asked["out"]
    where: Launch = asked["launch"]
    every = [Share(shard, asked["share"].of) for shard in range(asked["share"].of)]
    with owner.owned(out):
        todo = [share for share in every if not shares.is_made(place(out, share), kind, share, partial, quiet=True)]
        given = {**asked, "launch": LOCAL, "threads": where.threads(asked["threads"])}
        tasks = [(kind, {**given, "share": share}) for share in todo]
        with (
            console.Progress(kind, len(every), unit="parts", done=len(every) - len(todo)) as progress,
            contextlib.closing(launch.run(make_part, tasks, launch=where)) as finished,
        ):
            for _ in finished:
                progress.advance(1)
        for left in (out / PARTS_FOLDER).glob(".*.tmp"):  # of tasks that were lost
            shutil.rmtree(left, ignore_errors=True)
        parts = [shares.read(place(out, share)) for share in every]
        merging.check(parts)
        values = merging.write(parts, out)
    options.show(values)


def place(out: pathlib.Path, share: Share) -> pathlib.Path:
    """Return the folder of a part of the evaluation in the folder `out`."""
    return out / PARTS_FOLDER / f"{share.shard:05d}-of-{share.of:05d}"


def make_part(kind: str, given: dict[str, Any]) -> None:
    """Make a part by the command that makes it alone. Runs as a Ray task, so it may be retried, or run twice.

    It works in a folder of its own, which gets the part's name at the end, unless another did that meanwhile.

    Args:
      kind: command of dipn-eval.
      given: its options by name, as its function takes them; a dictionary, because each command has its own
        options.
    """
    from .. import cli

    target = place(given["out"], given["share"])
    own = temporary.temporary_path(target)
    try:
        commands: dict[str, Any] = cli.COMMANDS
        commands[kind](**{**given, "out": own})
        if not (target / PART).exists():
            files.move(own, target)
    except OSError:
        if not (target / PART).exists():
            raise
    finally:
        shutil.rmtree(own, ignore_errors=True)
