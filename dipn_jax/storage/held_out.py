"""Decide which episodes of a data set are held out, by one rule for training and exports that needs only sizes."""

from __future__ import annotations

import pathlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from dipn_jax.errors import UserError

MOST_HELD_OUT = 1000
"""Number of episodes that are held out at most."""


def begins(
    size: Float[np.ndarray, "B N 3"], *, before: Float[np.ndarray, "N 3"] | None = None
) -> Int[np.ndarray, " begun"]:
    """Return the rows at which a scene begins: those whose objects have other sizes than in the row before.

    Args:
      size: sizes of the objects of each episode (metres); episodes of one scene are neighbours.
      before: sizes in the episode before the first row; where there is none, the first row begins a scene.
    """
    first = before is None or bool((size[0] != before).any())
    return np.flatnonzero(np.concatenate([[first], (size[1:] != size[:-1]).any((1, 2))]))


def cut(sizes: Iterable[Float[np.ndarray, "_ _ 3"]], count: int, data: pathlib.Path) -> int:
    """Return the number of the first episode that is held out: about the last tenth is, 1,000 at most.

    It begins a scene, so that no scene is on both sides.

    Args:
      sizes: sizes of the objects (metres) of all episodes in order, in any number of parts.
      count: number of episodes.
      data: folder that they are from, for the error message.

    Raises:
      UserError: there are fewer than two scenes.
    """
    wanted = count - min(MOST_HELD_OUT, max(1, count // 10))
    best, first, last = 0, 0, None
    for size in sizes:
        found = first + begins(size, before=last)
        found = found[found > 0]
        if len(found):
            near = int(found[np.argmin(np.abs(found - wanted))])
            best = near if not best or abs(near - wanted) < abs(best - wanted) else best
        first, last = first + len(size), size[-1]
    if not best:
        raise UserError(f"data set {data}: {count} examples of one scene; want at least two scenes")
    return best
