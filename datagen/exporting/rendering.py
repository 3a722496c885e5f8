"""Pictures of episodes for an export: height, colour and labels, rendered on the device a few episodes at a time."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from dipn_jax.sight import render
from dipn_jax.structs import Array

from .columns import FRAMES, MOMENTS, Values

VIEWS_IN_MEMORY = 64
"""Views that are in memory at a time, about 0.4 MB each."""


def block(images: str) -> int:
    """Return how many episodes are rendered at a time."""
    return max(1, VIEWS_IN_MEMORY // (FRAMES if images == "all" else 1))


def draw(episodes: Any, images: str) -> Values:
    """Return the columns of pictures of episodes `[B]` (`columns.pictures`) that `--images` asks for."""
    found: Values = {}
    for moment in MOMENTS[images]:
        found |= _views(episodes.scene, _poses(episodes, moment), moment)
    return found


def _poses(episodes: Any, moment: str) -> Array:
    """Return the poses of episodes at a moment, `[B, N, 7]`, or `[B, F, N, 7]` at all recorded ones."""
    if moment == "after":
        return np.asarray(episodes.after)
    poses = np.asarray(episodes.poses)
    return poses[:, 0] if moment == "before" and poses.ndim == 4 else poses


def _views(scene: Any, poses: Array, moment: str) -> Values:
    """Return the pictures of scenes `[B, N]` at poses `[B, N, 7]` or `[B, F, N, 7]`."""
    lead = poses.shape[:-2]
    repeated = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), int(np.prod(lead[1:])), axis=0), scene)
    seen = render.observe(repeated, np.asarray(poses).reshape(-1, *poses.shape[-2:]))
    found = {
        f"height_{moment}": np.asarray(seen.height),
        f"color_{moment}": np.rint(255 * np.asarray(seen.color)).astype(np.uint8),
        f"label_{moment}": np.asarray(seen.label).astype(np.int8),
    }
    return {name: value.reshape(*lead, *value.shape[1:]) for name, value in found.items()}
