"""What all grasps are worth on many images that differ from the present one in places: a rough look, then a close one.

Three facts make it fast. The mean over all score maps is a sum over the cells that the network fills, so it changes by
what these cells change. The `compact` network is local: cells far from anything that moved keep their score. And only
the best images matter: which these may be is told from every second rotation, and from windows whose surroundings are
cut off; which of these they are from the other rotations, too; those few are then scored whole.
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
    BLOCK,
    SCALE,
    VIEW,
    GraspNet,
    flat_pixels,
    score_cells,
    score_image,
    turning_tables,
)
from dipn_jax.sight import fingers
from dipn_jax.workspace import ROTATIONS

FEW = 8
"""Images that are scored whole without a rough look."""
FINALISTS = 4
"""Images that are scored whole after one."""
SECOND = 16
"""Images that get a second rough look. On 24 packed rows of 3 to 8 the first, at half of the rotations, was off by a
fifth of what images differ by, and once the best one came ninth; both together by 3 %, and it was first or second."""
TURNS = (tuple(range(0, ROTATIONS // 2, 2)), tuple(range(1, ROTATIONS // 2, 2)))
"""Rotations of the first and of the second rough look."""
FELT = (36, 20)
"""Pixels across which a change is felt: along the closing axis (fingers begin 28 away), and across it."""
SEEN = 8
"""Pixels beyond those which a rough score looks at; the network sees 48."""
SIDES = (20, 28, 36, 44, 56, 80)
"""Cells of the windows' rows; even, the network has a stride of two of them. The compiled program holds each size."""
_CELLS = VIEW // BLOCK
_WIDER = 2 * (FELT[0] - FELT[1]) // BLOCK


@functools.cache
def _weights() -> Float[np.ndarray, "8 80 80 16"]:
    """How much each pixel of each cell counts in the mean over all score maps."""
    half = ROTATIONS // 2
    _, back = turning_tables(half)
    count = np.bincount(back.reshape(-1), minlength=half * VIEW**2 + 1)[: half * VIEW**2]
    return (count / back.size).astype(np.float32).reshape(half, _CELLS, _CELLS, BLOCK**2)


def _extents(
    changed: Bool[jax.Array, "H W"], turns: Int[np.ndarray, " T"]
) -> tuple[Float[jax.Array, "T 2"], Float[jax.Array, "T 2"]]:
    """Least (column, row) of the pixels `changed` in the turned views, and their extent, in pixels."""
    size, far = changed.shape[0], 1e4
    place = jnp.arange(size) - (size - 1) / 2
    ends = jnp.stack([jnp.where(changed, place, far).min(1), jnp.where(changed, place, -far).max(1)])
    points = jnp.stack([ends.reshape(-1), jnp.tile(place, 2)], -1)
    there = jnp.tile(changed.any(1), 2)[:, None]
    angles = turns.astype(np.float32) * np.float32(2 * np.pi / ROTATIONS)
    turned = jax.vmap(lambda a: geometry.rotate2d(points, -a))(angles) + (VIEW - 1) / 2
    least = jnp.where(there, turned, far).min(1)
    return least, jnp.maximum(jnp.where(there, turned, -far).max(1) - least, 0.0)


def _felt(
    cells: Int[jax.Array, "T S"], least: Float[jax.Array, "T 2"], extent: Float[jax.Array, "T 2"], axis: int
) -> Bool[jax.Array, "T S"]:
    """Which columns (axis 0) or rows (axis 1) of cells feel a change."""
    low, high = least[:, axis, None] - FELT[axis], least[:, axis, None] + extent[:, axis, None] + FELT[axis]
    return (cells >= low // BLOCK) & (cells <= high // BLOCK)


def _scores(logits: Float[jax.Array, "*b"], height: Float[jax.Array, "*b"]) -> Float[jax.Array, "*b"]:
    """Scores of pixels of normalized `height`; 0 on the table."""
    return jnp.where(height * SCALE[3] > fingers.EMPTY_HEIGHT, nnx.sigmoid(logits), 0.0)


def scores_now(network: GraspNet, now: Float[jax.Array, "224 224 4"]) -> Float[jax.Array, "8 80 80 16"]:
    """Scores of the cells of all turned views of an image."""
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
    """About what `turns` contribute to the mean of all scores on each image, less what they do now.

    Args:
      network: GN, `compact`, in evaluation mode.
      now: the present image.
      before: of `scores_now`.
      images: the others.
      wanted: which of them; others get 0.
      turns: rotations, of the first eight.
    """
    which = np.array(turns)
    weight, there, before = _weights()[which], turning_tables(ROTATIONS // 2)[0][which], before[which]
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
        least, extent = _extents(changed, which)
        needed = ((extent + 2 * (np.array(FELT) + SEEN)) / BLOCK - np.array([_WIDER, 0])).max()
        size = jnp.minimum(jnp.searchsorted(jnp.array(SIDES), needed), len(SIDES) - 1)
        branches: list[Callable[..., jax.Array]] = [functools.partial(again, rows) for rows in SIDES]
        branches.insert(0, lambda *_: jnp.zeros(()))
        return jax.lax.switch(jnp.where(want & changed.any(), size + 1, 0), branches, image, least, extent)

    return jax.lax.map(one, (images, wanted))


def appraise(
    network: GraspNet,
    now: Float[jax.Array, "224 224 4"],
    images: Float[jax.Array, "P 224 224 4"],
    wanted: Bool[jax.Array, " P"],
) -> tuple[Float[jax.Array, " P+1"], Float[jax.Array, " P+1"]]:
    """Mean and highest of all scores on each image; see `planner.Appraiser`.

    Args:
      network: GN, `compact`, in evaluation mode.
      now: the present image.
      images: the others.
      wanted: which of them.

    Returns:
      Of each image, of `now` first; as whole images give them for the FINALISTS best (for all if no more than FEW are
      wanted), the least of theirs for others.
    """
    count = len(wanted)

    def shortlist() -> tuple[jax.Array, jax.Array]:
        before = scores_now(network, now)
        first = rough_means(network, now, before, images, wanted, turns=TURNS[0])
        _, near = jax.lax.top_k(jnp.where(wanted, first, -jnp.inf), min(SECOND, count))
        second = rough_means(network, now, before, images[near], wanted[near], turns=TURNS[1])
        _, best = jax.lax.top_k(jnp.where(wanted[near], first[near] + second, -jnp.inf), min(FEW, count))
        return near[best], jnp.arange(min(FEW, count)) < FINALISTS

    def everyone() -> tuple[jax.Array, jax.Array]:
        _, best = jax.lax.top_k(wanted.astype(jnp.float32), min(FEW, count))
        return best, wanted[best]

    chosen, close = jax.lax.cond(wanted.sum() > FEW, shortlist, everyone)

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
