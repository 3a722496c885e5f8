"""What `dipn-eval clear` and `sweep` have in common: clear tables and write the results. Imports no JAX at the top."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError

from .. import options
from ..workers import shares
from ..workers.shares import WHOLE, Share
from .camera import Camera
from .tables import SHIPPED, Tables

if TYPE_CHECKING:
    from dipn_jax.engine import Engine
    from dipn_jax.storage import resume

    from .on_tables import TablePolicy

MAX_CANDIDATES = 4096
"""Largest number of pushes that may be considered at a time."""
SIMULATED_PUSH = 0.10
"""Metres: a shorter push is simulated until one of this length would have ended."""


def settings(given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a command by name, those of its tables and camera as `tables.NAME` and `camera.NAME`."""
    tables: Tables = given["tables"]
    result: dict[str, Any] = {}
    for key, value in options.settings(given).items():
        if isinstance(value, (Tables, Camera)):
            result |= {f"{key}.{name}": part for name, part in dataclasses.asdict(value).items()}
        else:
            result[key] = value
    return result | ({} if tables.cases in (*SHIPPED, "random") else {"tables.cases": tables.path()})


def check(
    out: pathlib.Path,
    seed: int,
    tables: Tables,
    *,
    candidates: int,
    distances: tuple[float, ...],
    gamma: float,
    threshold: float,
) -> None:
    """Raise a UserError for options that make no sense, and a case file that cannot be used."""
    from dipn_jax.planning.policy_config import LONGEST_PUSH

    options.check(out, seed, candidates=candidates)
    console.require_between(1, MAX_CANDIDATES, candidates=candidates)
    if not distances:
        raise UserError("--distances: want at least one")
    for distance in distances:
        console.require_between(0.01, LONGEST_PUSH, distances=distance)
    if candidates < len(distances):
        raise UserError(f"--candidates {candidates}: want at least one for each of the {len(distances)} distances")
    console.require_between(0.0, 10.0, gamma=gamma, threshold=threshold)
    tables.slots()  # reads the case file


def inputs(runs: dict[str, pathlib.Path], tables: Tables) -> list[pathlib.Path]:
    """Return the runs and files that the results depend on, besides the options."""
    path = tables.path()
    return [*runs.values(), *([path] if path else [])]


def clear(
    out: pathlib.Path,
    decide: TablePolicy,
    physics: Engine,
    tables: Tables,
    *,
    given: dict[str, Any],
    runs: dict[str, pathlib.Path],
    longest: float,
    remember: bool,
    share: Share = WHOLE,
    kind: str = "clear",
    command: Sequence[str] = (),
) -> dict[str, Any]:
    """Clear tables and write the results, or the part of this worker; continues where it was interrupted.

    Args:
      out: folder of the results.
      decide: decides on every table.
      physics: physics engine.
      tables: the tables to clear.
      given: options, for `settings.json`.
      runs: networks that `decide` uses.
      longest: metres of the longest push.
      remember: whether the scores of grasps like one that missed are halved as long as the table looks the same.
      share: which tables this worker clears; every worker drops all of them, which takes little time.
      kind: command of dipn-eval that this belongs to.
      command: its options that make the evaluation, without `--out`, `--shard` and `--of`.

    Returns:
      The metrics; none of a part.

    Raises:
      UserError: another process has the folder.
    """
    from dipn_jax.storage import owner, resume

    from . import lockstep

    seed = given["seed"]
    partial: resume.Partial = resume.Partial(out, given, inputs=inputs(runs, tables), part=share.number_and_count())
    with owner.owned(out):
        if shares.is_made(out, kind, share, partial):
            return {}
        instances = tables.make(physics, seed=seed)
        rows = share.rows(len(instances))
        mine = [instances[row] for row in rows]
        ended = lockstep.clear(mine, physics, decide, partial, seed=seed, longest=longest, remember=remember)
        names = lockstep.save(ended, out, numbers=rows)
        if not share.whole:
            shares.write(
                out,
                kind,
                share,
                total=len(instances),
                command=command,
                given=given,
                partial=partial,
                names=names,
                about={},
            )
            return {}
        values = lockstep.summary(ended)
        options.finish(out, values, given, partial)
    return values
