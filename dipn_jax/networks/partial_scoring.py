"""Grasp scores of many images that differ from the present one in places: first rough ones, then exact ones.

Three facts make it fast. The mean over all score maps is a sum over the cells that the network fills, so it changes by
what these cells change. The `compact` network is local: cells far from anything that moved keep their score. And only
the best images matter: candidates for these are found from every second rotation, and from windows whose surroundings
are cut off; the other rotations narrow them down; those that remain are then scored whole.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Bool, Float, Int

from dipn_jax import geometry
from dipn_jax.networks.grasp import (
    CELL_PIXELS,
    INPUT_SCALE,
    VIEW_PIXELS,
    GraspNet,
    flat_pixels,
    score_cells,
    score_image,
    turning_tables,
)
from dipn_jax.sight import fingers
from dipn_jax.workspace import ROTATIONS

SCORED_WHOLE = 8
"""Images that are scored whole without a rough score, if no more are wanted."""
FINALISTS = 4
"""Images that are scored whole after the rough scores."""
SECOND_PASS_IMAGES = 16
"""Images that get the second rough score. Measured on 24 packed rows of 3 to 8 objects: the first score, at half of the
rotations, was off by a fifth of the differences between images, and ranked the best image ninth once; both scores
together were off by 3 %, and ranked it first or second."""
PASS_TURNS = (tuple(range(0, ROTATIONS // 2, 2)), tuple(range(1, ROTATIONS // 2, 2)))
"""Rotations of the first and of the second rough score."""
AFFECTED_PIXELS = (36, 20)
"""Pixels from a change within which scores change: along the closing axis (fingers begin 28 away), and across it."""
CONTEXT_PIXELS = 8
"""Pixels around those that a rough score takes into account; the network sees 48."""
WINDOW_CELLS = (20, 28, 36, 44, 56, 80)
"""Possible rows of a window, in cells; even, because the network has a stride of two. Each size is compiled."""
_VIEW_CELLS = VIEW_PIXELS // CELL_PIXELS
"""Cells along a side of a view."""
_WIDER_CELLS = 2 * (AFFECTED_PIXELS[0] - AFFECTED_PIXELS[1]) // CELL_PIXELS
"""Cells by which a window has more columns than rows."""


@functools.cache
def _weights() -> Float[np.ndarray, "8 80 80 16"]:
    """Return the weight of each pixel of each cell in the mean over all score maps."""
    half = ROTATIONS // 2
    _, back = turning_tables(half)
    count = np.bincount(back.reshape(-1), minlength=half * VIEW_PIXELS**2 + 1)[: half * VIEW_PIXELS**2]
    return (count / back.size).astype(np.float32).reshape(half, _VIEW_CELLS, _VIEW_CELLS, CELL_PIXELS**2)


def _extents(
    changed: Bool[jax.Array, "H W"], turns: Int[np.ndarray, " T"]
) -> tuple[Float[jax.Array, "T 2"], Float[jax.Array, "T 2"]]:
    """Return the least (column, row) of pixels `changed` in turned views, and their extent, in pixels."""
    size, far = changed.shape[0], 1e4
    place = jnp.arange(size) - (size - 1) / 2
    ends = jnp.stack([jnp.where(changed, place, far).min(1), jnp.where(changed, place, -far).max(1)])
    points = jnp.stack([ends.reshape(-1), jnp.tile(place, 2)], -1)
    there = jnp.tile(changed.any(1), 2)[:, None]
    angles = turns.astype(np.float32) * np.float32(2 * np.pi / ROTATIONS)
    turned = jax.vmap(lambda a: geometry.rotate2d(points, -a))(angles) + (VIEW_PIXELS - 1) / 2
    least = jnp.where(there, turned, far).min(1)
    return least, jnp.maximum(jnp.where(there, turned, -far).max(1) - least, 0.0)


def _affected(
    cells: Int[jax.Array, "T S"], least: Float[jax.Array, "T 2"], extent: Float[jax.Array, "T 2"], axis: int
) -> Bool[jax.Array, "T S"]:
    """Return which columns (axis 0) or rows (axis 1) of `cells` have a changed pixel in their receptive field."""
    low, high = (
        least[:, axis, None] - AFFECTED_PIXELS[axis],
        least[:, axis, None] + extent[:, axis, None] + AFFECTED_PIXELS[axis],
    )
    return (cells >= low // CELL_PIXELS) & (cells <= high // CELL_PIXELS)


def _scores(logits: Float[jax.Array, "*b"], height: Float[jax.Array, "*b"]) -> Float[jax.Array, "*b"]:
    """Return the scores of pixels of normalized `height`; 0 on the table."""
    return jnp.where(height * INPUT_SCALE[3] > fingers.EMPTY_HEIGHT, nnx.sigmoid(logits), 0.0)


def scores_now(network: GraspNet, now: Float[jax.Array, "224 224 4"]) -> Float[jax.Array, "8 80 80 16"]:
    """Return scores of the cells of all turned views of an image."""
    half = ROTATIONS // 2
    there, _ = turning_tables(half)
    return _scores(score_cells(network, now, half), flat_pixels(now)[there][..., 3])


def rough_means(
    network: GraspNet,
    now: Float[jax.Array, "224 224 4"],
    before: Float[jax.Array, "8 80 80 16"],
    images: Float[jax.Array, "P 224 224 4"],
    wanted: Bool[jax.Array, " P"],
    *,
    turns: tuple[int, ...],
) -> Float[jax.Array, " P"]:
    """Return estimates, from rotations `turns` alone, of how each image's mean score differs from the present one's.

    Args:
      network: GN, `compact`, in evaluation mode.
      now: the present image.
      before: result of `scores_now`.
      images: the others.
      wanted: which of them; others get 0.
      turns: rotations, of the first eight.
    """
    which = np.array(turns)
    weight, there, before = _weights()[which], turning_tables(ROTATIONS // 2)[0][which], before[which]
    cells = network.body.cells  # type: ignore[union-attr]

    def again(rows: int, image: jax.Array, least: jax.Array, extent: jax.Array) -> jax.Array:
        """Score windows of `rows` cells around what changed."""
        shape = np.array([min(rows + _WIDER_CELLS, _VIEW_CELLS), rows])
        at = 2 * jnp.round(((least + extent / 2) / CELL_PIXELS - shape / 2) / 2).astype(jnp.int32)
        at = jnp.clip(at, 0, _VIEW_CELLS - shape)

        def cut(stack: jax.Array | np.ndarray) -> jax.Array:
            part = lambda m, c: jax.lax.dynamic_slice(m, (c[1], c[0], 0), (*shape[::-1], m.shape[-1]))  # noqa: E731
            return jax.vmap(part)(jnp.asarray(stack), at)

        pixels = flat_pixels(image)[cut(there)]
        fresh = _scores(cells(pixels.reshape(*pixels.shape[:3], -1)), pixels[..., 3])
        cols, lines = (_affected(at[:, i, None] + np.arange(shape[i]), least, extent, i) for i in range(2))
        inside = (lines[:, :, None] & cols[:, None, :])[..., None]
        return jnp.where(inside, cut(weight) * (fresh - cut(before)), 0.0).sum()

    def one(args: tuple[jax.Array, jax.Array]) -> jax.Array:
        image, want = args
        changed = (image != now).any(-1)
        least, extent = _extents(changed, which)
        needed = (
            (extent + 2 * (np.array(AFFECTED_PIXELS) + CONTEXT_PIXELS)) / CELL_PIXELS - np.array([_WIDER_CELLS, 0])
        ).max()
        size = jnp.minimum(jnp.searchsorted(jnp.array(WINDOW_CELLS), needed), len(WINDOW_CELLS) - 1)
        branches: list[Callable[..., jax.Array]] = [functools.partial(again, rows) for rows in WINDOW_CELLS]
        branches.insert(0, lambda *_: jnp.zeros(()))
        return jax.lax.switch(jnp.where(want & changed.any(), size + 1, 0), branches, image, least, extent)

    return jax.lax.map(one, (images, wanted))


def mean_and_best(
    network: GraspNet,
    now: Float[jax.Array, "224 224 4"],
    images: Float[jax.Array, "P 224 224 4"],
    wanted: Bool[jax.Array, " P"],
) -> tuple[Float[jax.Array, " P+1"], Float[jax.Array, " P+1"]]:
    """Return the mean and the highest of all scores on each image; see `planner.ScoreSummary`.

    Args:
      network: GN, `compact`, in evaluation mode.
      now: the present image.
      images: the others.
      wanted: which of them.

    Returns:
      Both of `now` first. Exact for the FINALISTS best images (for all if no more than SCORED_WHOLE are wanted); the
      others get the least of the exact values.
    """
    count = len(wanted)

    def shortlist() -> tuple[jax.Array, jax.Array]:
        before = scores_now(network, now)
        first = rough_means(network, now, before, images, wanted, turns=PASS_TURNS[0])
        _, near = jax.lax.top_k(jnp.where(wanted, first, -jnp.inf), min(SECOND_PASS_IMAGES, count))
        second = rough_means(network, now, before, images[near], wanted[near], turns=PASS_TURNS[1])
        _, best = jax.lax.top_k(jnp.where(wanted[near], first[near] + second, -jnp.inf), min(SCORED_WHOLE, count))
        return near[best], jnp.arange(min(SCORED_WHOLE, count)) < FINALISTS

    def everyone() -> tuple[jax.Array, jax.Array]:
        _, best = jax.lax.top_k(wanted.astype(jnp.float32), min(SCORED_WHOLE, count))
        return best, wanted[best]

    chosen, close = jax.lax.cond(wanted.sum() > SCORED_WHOLE, shortlist, everyone)

    def whole(args: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        image, want = args

        def score() -> tuple[jax.Array, jax.Array]:
            scores = score_image(network, image)
            return scores.mean(), scores.max()

        nothing = (jnp.zeros(()), jnp.zeros(()))
        return jax.lax.cond(want, score, lambda: nothing)

    means, highest = jax.lax.map(whole, (images[chosen], close))
    mean_now, highest_now = whole((now, wanted.any()))

    def spread(first: jax.Array, values: jax.Array) -> jax.Array:
        least = jnp.where(close, values, jnp.inf).min(initial=1.0)
        return jnp.append(first, jnp.full(count, least).at[chosen].set(jnp.where(close, values, least)))

    return spread(mean_now, means), spread(highest_now, highest)
