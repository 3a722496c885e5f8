"""Split of a data set: which examples are held out for the learning curve."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from dipn_jax import structs
from dipn_jax.storage import held_out


def split(episodes: Any, data: pathlib.Path) -> tuple[Any, Any]:
    """Return the training examples, and about the last tenth, 1,000 at most, which is held out (`held_out.cut`).

    No scene is on both sides.

    Args:
      episodes: a struct with `scene` and a leading `[B]`; the actions tried on one scene are neighbours.
      data: folder that they are from, for the error message.

    Raises:
      UserError: there are fewer than two scenes.
    """
    size = np.asarray(episodes.scene.size)
    cut = held_out.cut([size], len(size), data)
    return structs.take(episodes, slice(0, cut)), structs.take(episodes, slice(cut, len(size)))
