"""Split of a data set: which examples are held out for the learning curve."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from dipn_jax import structs
from dipn_jax.errors import UserError


def split(episodes: Any, data: pathlib.Path) -> tuple[Any, Any]:
    """Return the training examples, and about the last tenth, 1,000 at most, which is held out.

    No scene is on both sides.

    Args:
      episodes: a struct with `scene` and a leading `[B]`; the actions tried on one scene are neighbours.
      data: folder that they are from, for the error message.

    Raises:
      UserError: there are fewer than two scenes.
    """
    size = np.asarray(episodes.scene.size)
    begins = np.flatnonzero((size[1:] != size[:-1]).any((1, 2))) + 1  # first examples of the second, third, ... scene
    if not len(begins):
        raise UserError(f"data set {data}: {len(size)} examples of one scene; want at least two scenes")
    wanted = len(size) - min(1000, max(1, len(size) // 10))
    cut = int(begins[np.argmin(np.abs(begins - wanted))])
    return structs.take(episodes, slice(0, cut)), structs.take(episodes, slice(cut, len(size)))
