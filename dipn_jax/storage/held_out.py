"""Decide which episodes of a data set are held out, by one rule for training and exports that needs only sizes."""

from __future__ import annotations

import pathlib
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from dipn_jax.errors import UserError

MOST_HELD_OUT = 1000
"""Number of episodes that are held out at most."""
REACH = 100
"""Episodes before and after the wanted place among which the beginning of a scene is looked for first."""


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


def cut(
    read: Callable[[slice], Float[np.ndarray, "_ _ 3"]], count: int, data: pathlib.Path, *, reach: int = REACH
) -> int:
    """Return the number of the first episode that is held out: about the last tenth is, 1,000 at most.

    It begins a scene, so that no scene is on both sides: of those that begin nearest to where a tenth would, the first.

    Args:
      read: function of a slice of episodes that returns the sizes of their objects (metres); it is asked for those
        near the cut alone.
      count: number of episodes.
      data: folder that they are from, for the error message.
      reach: episodes before and after the wanted place among which a scene is looked for first.

    Raises:
      UserError: there are fewer than two scenes.
    """
    wanted = count - min(MOST_HELD_OUT, max(1, count // 10))
    while True:
        first, end = max(wanted - reach - 1, 0), min(wanted + reach + 1, count)
        found = begins(read(slice(first, end)))[1:] + first  # what the first row begins is not known
        if len(found):
            return int(found[np.argmin(np.abs(found - wanted))])
        if (first, end) == (0, count):
            raise UserError(f"data set {data}: {count} examples of one scene; want at least two scenes")
        reach *= 4
