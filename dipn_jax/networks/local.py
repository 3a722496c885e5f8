"""What all grasps are worth on many images that differ from the present one in places: a rough look, then a close one.

Three facts make it fast. The mean over all score maps is a sum over the cells that the network fills, so it changes by
what these cells change. The `compact` network is local: cells far from anything that moved keep their score. And only
the best images matter: which these are can be told from every second rotation, and from windows whose surroundings are
cut off; those few are then scored whole.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import geometry
from dipn_jax.networks.grasp import (
    BLOCK,
    EMPTY,
    SCALE,
    VIEW,
    GraspNet,
    flat_pixels,
    score_cells,
    score_image,
    turning_tables,
)
from dipn_jax.workspace import ROTATIONS

FINALISTS = 8
"""Images that are scored whole."""
TURNS = tuple(range(0, ROTATIONS // 2, 2))
"""Rotations of the rough look."""
FELT = (36, 20)
"""Pixels across which a change is felt: along the closing axis (fingers begin 28 away), and across it."""
SEEN = 8
"""Pixels beyond those which a rough score looks at; the network sees 48."""
SIDES = (20, 28, 36, 44, 56, 80)
"""Cells of the windows' rows; even, the network has a stride of two of them. The compiled program holds each size."""
_CELLS = VIEW // BLOCK
_WIDER = 2 * (FELT[0] - FELT[1]) // BLOCK


@functools.cache
def _weights() -> np.ndarray:
    """How much each pixel of each cell `[len(TURNS), 80, 80, 16]` counts in the mean over all score maps."""
    half = ROTATIONS // 2
    _, back = turning_tables(half)
    count = np.bincount(back.reshape(-1), minlength=half * VIEW**2 + 1)[: half * VIEW**2]
    return (count / back.size).astype(np.float32).reshape(half, _CELLS, _CELLS, BLOCK**2)[np.array(TURNS)]


def _extents(changed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Least (column, row) of the pixels `changed [H, W]` in each turned view, and their extent: `[T, 2]` pixels."""
    size, far = changed.shape[0], 1e4
    place = jnp.arange(size) - (size - 1) / 2
    ends = jnp.stack([jnp.where(changed, place, far).min(1), jnp.where(changed, place, -far).max(1)])
    points = jnp.stack([ends.reshape(-1), jnp.tile(place, 2)], -1)
    there = jnp.tile(changed.any(1), 2)[:, None]
    angles = np.array(TURNS, np.float32) * (2 * np.pi / ROTATIONS)
    turned = jax.vmap(lambda a: geometry.rotate2d(points, -a))(angles) + (VIEW - 1) / 2
    least = jnp.where(there, turned, far).min(1)
    return least, jnp.maximum(jnp.where(there, turned, -far).max(1) - least, 0.0)


def _felt(cells: jax.Array, least: jax.Array, extent: jax.Array, axis: int) -> jax.Array:
    """Which columns (axis 0) or rows (axis 1) `cells [T, S]` feel a change."""
    low, high = least[:, axis, None] - FELT[axis], least[:, axis, None] + extent[:, axis, None] + FELT[axis]
    return (cells >= low // BLOCK) & (cells <= high // BLOCK)


def _scores(logits: jax.Array, height: jax.Array) -> jax.Array:
    """Scores of pixels of normalized `height`; 0 on the table."""
    return jnp.where(height * SCALE[3] > EMPTY, nnx.sigmoid(logits), 0.0)


def rough_means(network: GraspNet, now: jax.Array, images: jax.Array, wanted: jax.Array) -> jax.Array:
    """About the mean of all scores on each image `[P]`, less that on `now`; arguments as of `appraise`."""
    weight, there = _weights(), turning_tables(ROTATIONS // 2)[0][np.array(TURNS)]
    heights = (flat_pixels(now)[there])[..., 3]
    before = _scores(score_cells(network, now, ROTATIONS // 2)[np.array(TURNS)], heights)
    cells = network.body.cells  # type: ignore[union-attr]

    def again(rows: int, image: jax.Array, least: jax.Array, extent: jax.Array) -> jax.Array:
        """Score windows of `rows` cells around what changed."""
        shape = np.array([min(rows + _WIDER, _CELLS), rows])
        at = 2 * jnp.round(((least + extent / 2) / BLOCK - shape / 2) / 2).astype(jnp.int32)
        at = jnp.clip(at, 0, _CELLS - shape)

        def cut(stack: jax.Array | np.ndarray) -> jax.Array:
            part = lambda m, c: jax.lax.dynamic_slice(m, (c[1], c[0], 0), (*shape[::-1], m.shape[-1]))  # noqa: E731
            return jax.vmap(part)(jnp.asarray(stack), at)

        pixels = flat_pixels(image)[cut(there)]
        fresh = _scores(cells(pixels.reshape(*pixels.shape[:3], -1)), pixels[..., 3])
        cols, lines = (_felt(at[:, i, None] + np.arange(shape[i]), least, extent, i) for i in range(2))
        inside = (lines[:, :, None] & cols[:, None, :])[..., None]
        return jnp.where(inside, cut(weight) * (fresh - cut(before)), 0.0).sum()

    def one(args: tuple[jax.Array, jax.Array]) -> jax.Array:
        image, want = args
        changed = (image != now).any(-1)
        least, extent = _extents(changed)
        needed = ((extent + 2 * (np.array(FELT) + SEEN)) / BLOCK - np.array([_WIDER, 0])).max()
        size = jnp.minimum(jnp.searchsorted(jnp.array(SIDES), needed), len(SIDES) - 1)
        branches: list[Callable[..., jax.Array]] = [functools.partial(again, rows) for rows in SIDES]
        branches.insert(0, lambda *_: jnp.zeros(()))
        return jax.lax.switch(jnp.where(want & changed.any(), size + 1, 0), branches, image, least, extent)

    return jax.lax.map(one, (images, wanted))


def appraise(network: GraspNet, now: jax.Array, images: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and highest of all scores on each image; see `planner.Appraiser`.

    Args:
      network: GN, `compact`, in evaluation mode.
      now: `[224, 224, 4]`.
      images: `[P, 224, 224, 4]`.
      wanted: `[P]` bool.

    Returns:
      `[1 + P]` each, of `now` first; as whole images give them for the FINALISTS best, the least of theirs for others.
    """
    rough = jnp.where(wanted, rough_means(network, now, images, wanted), -jnp.inf)
    _, chosen = jax.lax.top_k(rough, min(FINALISTS, len(rough)))

    def whole(args: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        image, want = args

        def score() -> tuple[jax.Array, jax.Array]:
            scores = score_image(network, image)
            return scores.mean(), scores.max()

        nothing = (jnp.zeros(()), jnp.zeros(()))
        return jax.lax.cond(want, score, lambda: nothing)

    means, highest = jax.lax.map(whole, (images[chosen], wanted[chosen]))
    mean_now, highest_now = whole((now, wanted.any()))

    def spread(first: jax.Array, values: jax.Array) -> jax.Array:
        return jnp.append(first, jnp.full(len(rough), values.min()).at[chosen].set(values))

    return spread(mean_now, means), spread(highest_now, highest)
