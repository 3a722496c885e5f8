"""Join the data sets of a training, and split them into episodes to learn from and held-out ones for the curve."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Iterator

import numpy as np

from dipn_jax.errors import UserError
from dipn_jax.storage import held_out, records
from dipn_jax.storage.on_demand import DataSet, Episodes, Rows
from dipn_jax.storage.space import Space

Folders = pathlib.Path | tuple[pathlib.Path, ...]
"""One data set, or several."""
ChooseEpisodes = Callable[[DataSet, pathlib.Path], np.ndarray | None]
"""Function of a data set and its folder: the numbers of the episodes that are used, ascending, or None for all."""
Chosen = list[tuple[DataSet, Rows]]
"""Data sets, each with the numbers of some of its episodes."""


@dataclasses.dataclass(frozen=True)
class Split:
    """Episodes of one data set or of several, split; none of them has been read."""

    learnt: Episodes
    held_out: Episodes  # about the last tenth of each data set
    parts: tuple[int, ...]  # number of those learnt of each data set
    fingerprint: str


def load_split(
    data: Folders,
    *,
    kind: str,
    what: str = "episodes",
    choose: ChooseEpisodes = lambda *_: None,
    limit: int | None = None,
    space: Space | None = None,
) -> Split:
    """Check data sets and split each; they may have different numbers of object slots.

    Args:
      data: their folders.
      kind: of their episodes.
      what: what the episodes are called where --limit is wrong.
      choose: which episodes of each are used.
      limit: learn from this number of episodes only, the first ones; None: from all. The same ones are held out.
      space: where to put them; None: in memory.

    Raises:
      UserError: no folder; one is damaged, holds something else, or cannot be split; two have scenes in common; or
        there are fewer episodes than the limit.
    """
    folders = (data,) if isinstance(data, pathlib.Path) else data
    if not folders:
        raise UserError(f"--data: want at least one folder of dipn-datagen {kind}")
    sets = [records.opened(folder, kind=kind) for folder in folders]
    chosen = [choose(of, folder) for of, folder in zip(sets, folders, strict=True)]
    used: list[Rows] = [range(len(of)) if rows is None else rows for of, rows in zip(sets, chosen, strict=True)]
    cuts = [_cut(of, rows, folder) for of, rows, folder in zip(sets, used, folders, strict=True)]
    learnt = [(of, rows[:cut]) for of, rows, cut in zip(sets, used, cuts, strict=True)]
    held = [(of, rows[cut:]) for of, rows, cut in zip(sets, used, cuts, strict=True)]
    if len(folders) > 1:
        _refuse_overlap(learnt, held)
    parts = _first(cuts, limit, what=what)
    learnt = [(of, rows[:part]) for (of, rows), part in zip(learnt, parts, strict=True)]
    space = space or Space()
    return Split(Episodes(learnt, space), Episodes(held, space), parts, ":".join(of.fingerprint for of in sets))


def _cut(of: DataSet, rows: Rows, folder: pathlib.Path) -> int:
    """Return how many of these episodes of a data set are learnt from (`held_out.cut`)."""
    return held_out.cut(lambda some: of.column("scene.size", rows[some]), len(rows), folder)


def _first(parts: list[int], limit: int | None, *, what: str) -> tuple[int, ...]:
    """Return how many episodes are learnt from of each data set that has `parts` to learn from.

    Raises:
      UserError: there are fewer than `limit`; `what` says of what.
    """
    count = sum(parts)
    if limit is not None and not 1 <= limit <= count:
        raise UserError(f"--limit {limit}: want 1 to {count}, the {what} of --data that are not held out")
    return within(tuple(parts), count if limit is None else limit)


def within(parts: tuple[int, ...], count: int) -> tuple[int, ...]:
    """Return how many of the first `count` episodes are of each data set, if `parts` are all of each."""
    begins = np.cumsum([0, *parts[:-1]])
    return tuple(int(np.clip(count - begin, 0, part)) for begin, part in zip(begins, parts, strict=True))


def _refuse_overlap(learnt: Chosen, held: Chosen) -> None:
    """Raise a UserError if a scene of one data set is learnt from and the same scene of another is held out."""
    slots = max(of.slots for of, _ in learnt)
    known = {scene for of, rows in held for scene in _scenes(of, rows, slots)}
    masses = np.concatenate([of.column("scene.mass", rows)[:, 0] for of, rows in held])
    number = 0
    for of, rows in learnt:
        alike = np.flatnonzero(np.isin(of.column("scene.mass", rows)[:, 0], masses))  # few: the rest need not be read
        near = alike + rows.start if isinstance(rows, range) else rows[alike]
        number += sum(scene in known for scene in _scenes(of, near, slots))
    if number:
        raise UserError(
            f"--data: {number} episodes would be learnt from whose scenes another of these data sets holds out; give "
            "one of them, or make one with another --seed"
        )


def _scenes(of: DataSet, rows: Rows, slots: int) -> Iterator[bytes]:
    """Yield what tells the scene of each episode from others: sizes, masses and frictions, which are drawn for each."""
    leaves = [of.column(f"scene.{name}", rows) for name in ("size", "mass", "friction")]
    more = slots - of.slots
    padded = [np.pad(leaf, [(0, 0), (0, more)] + [(0, 0)] * (leaf.ndim - 2)) for leaf in leaves]
    for row in zip(*padded, strict=True):
        yield b"".join(leaf.tobytes() for leaf in row)
