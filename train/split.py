"""Join the data sets of a training, and split them into episodes to learn from and held-out ones for the curve."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.storage import held_out, records
from dipn_jax.storage.space import Filled, Space
from dipn_jax.structs import ABSENT, Array
from dipn_jax.world import scenes

Folders = pathlib.Path | tuple[pathlib.Path, ...]
"""One data set, or several."""
Choose = Callable[[Any, pathlib.Path], np.ndarray | None]
"""Function of the episodes of a data set and its folder: the numbers of those that are used, or None for all."""
_COPIED_AT_A_TIME = 10_000
"""Episodes that are copied at a time."""


@dataclasses.dataclass(frozen=True)
class Sides:
    """Episodes of one data set or of several, split."""

    learnt: Any  # [B]
    held_out: Any  # [B]: the last tenth of each data set
    parts: tuple[int, ...]  # number of those learnt of each data set
    fingerprint: str

    @property
    def slots(self) -> int:
        """The number of object slots."""
        return int(self.learnt.scene.shape.shape[1])


def load_sides(data: Folders, *, kind: str, choose: Choose = lambda *_: None, space: Space | None = None) -> Sides:
    """Load data sets and split each; they may have different numbers of object slots.

    Args:
      data: their folders.
      kind: of their episodes.
      choose: which episodes of each are used.
      space: where to put them; None: in memory.

    Raises:
      UserError: no folder; one is damaged, holds something else, or cannot be split; or two have scenes in common.
    """
    folders = (data,) if isinstance(data, pathlib.Path) else data
    if not folders:
        raise UserError(f"--data: want at least one folder of dipn-datagen {kind}")
    space = space or Space()
    loaded, prints = zip(*[records.load(folder, kind=kind, space=space) for folder in folders], strict=True)
    chosen = [choose(episodes, folder) for episodes, folder in zip(loaded, folders, strict=True)]
    if len(folders) == 1 and chosen[0] is None:
        learnt, held = split(loaded[0], folders[0])  # both are views
        return Sides(learnt, held, (len(learnt.fault),), prints[0])
    used = [np.arange(len(of.fault)) if rows is None else rows for of, rows in zip(loaded, chosen, strict=True)]
    cuts = [_cut(of.scene.size[rows], folder) for of, rows, folder in zip(loaded, used, folders, strict=True)]
    learnt, held = (
        _gathered([(of, rows[side]) for of, rows, side in zip(loaded, used, sides, strict=True)], space)
        for sides in zip(*[(slice(0, cut), slice(cut, None)) for cut in cuts], strict=True)
    )
    if len(folders) > 1:
        _refuse_overlap(learnt, held)
    return Sides(learnt, held, tuple(cuts), ":".join(prints))


def _gathered(parts: list[tuple[Any, np.ndarray]], space: Space) -> Any:
    """Return the episodes with these numbers, of one struct after another, all with as many slots as any has."""
    slots = max(episodes.scene.shape.shape[1] for episodes, _ in parts)
    made, at = Filled(sum(len(rows) for _, rows in parts), space, what="episodes"), 0
    for episodes, rows in parts:
        for begin in range(0, len(rows), _COPIED_AT_A_TIME):
            some = structs.take(episodes, rows[begin : begin + _COPIED_AT_A_TIME])
            made.put(at, widened(some, slots))
            at += len(some.fault)
    return made.whole


def _refuse_overlap(learnt: Any, held: Any) -> None:
    """Raise a UserError if a scene of one data set is learnt from and the same scene of another is held out."""
    known = set(_scenes(held))
    if number := sum(scene in known for scene in _scenes(learnt)):
        raise UserError(
            f"--data: {number} episodes would be learnt from whose scenes another of these data sets holds out; give "
            "one of them, or make one with another --seed"
        )


def _scenes(episodes: Any) -> Iterator[bytes]:
    """Yield what tells the scene of each episode from others: sizes, masses and frictions, which are drawn for each."""
    for leaves in zip(episodes.scene.size, episodes.scene.mass, episodes.scene.friction, strict=True):
        yield b"".join(np.asarray(leaf).tobytes() for leaf in leaves)


def first(learnt: Any, limit: int | None, *, what: str) -> Any:
    """Return the first `limit` of the episodes `learnt [B]`, or all where there is no limit.

    Raises:
      UserError: there are fewer; `what` says of what.
    """
    count = len(learnt.fault)
    if limit is not None and not 1 <= limit <= count:
        raise UserError(f"--limit {limit}: want 1 to {count}, the {what} of --data that are not held out")
    return structs.take(learnt, slice(0, limit))


def within(parts: tuple[int, ...], count: int) -> tuple[int, ...]:
    """Return how many of the first `count` episodes are of each data set, if `parts` are all of each."""
    begins = np.cumsum([0, *parts[:-1]])
    return tuple(int(np.clip(count - begin, 0, part)) for begin, part in zip(begins, parts, strict=True))


def widened(episodes: Any, slots: int) -> Any:
    """Return episodes `[B, N]` as `[B, slots]`, so that data sets of different numbers of objects can be joined."""
    more = slots - episodes.scene.shape.shape[1]
    if not more:
        return episodes

    def pad(leaf: Array, value: float = 0) -> np.ndarray:
        edges = [(0, 0), (0, more)] + [(0, 0)] * (leaf.ndim - 2)
        return np.pad(leaf, edges, constant_values=value)

    def park(poses: Array) -> np.ndarray:
        away = np.broadcast_to(scenes.parked(more), (*poses.shape[:-2], more, 7))
        return np.concatenate([poses, away], -2)

    changes = {name: park(getattr(episodes, name)) for name in ("poses", "after") if hasattr(episodes, name)}
    changes |= {"held": pad(episodes.held)} if hasattr(episodes, "held") else {}
    scene = jax.tree.map(pad, episodes.scene).replace(shape=pad(episodes.scene.shape, ABSENT))
    return episodes.replace(scene=scene, **changes)


def split(episodes: Any, data: pathlib.Path) -> tuple[Any, Any]:
    """Return the training examples, and about the last tenth, 1,000 at most, which is held out (`held_out.cut`).

    No scene is on both sides.

    Args:
      episodes: a struct with `scene` and a leading `[B]`; the actions tried on one scene are neighbours.
      data: folder that they are from, for the error message.

    Raises:
      UserError: there are fewer than two scenes.
    """
    cut = _cut(episodes.scene.size, data)
    return structs.take(episodes, slice(0, cut)), structs.take(episodes, slice(cut, None))


def _cut(size: Array, data: pathlib.Path) -> int:
    """Return how many of the episodes are learnt from, as `split` does; `size [B, N, 3]` are those of their scenes."""
    return held_out.cut([np.asarray(size)], len(size), data)
