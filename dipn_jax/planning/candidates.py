"""The actions to consider: pushes from the contours of object bundles, grasps at pixels.

Everything runs on the device on a padded number of candidates; nothing is traced out point by point.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Key

from dipn_jax import geometry
from dipn_jax.sight import fingers, masks
from dipn_jax.structs import ABSENT, Array, Grasp, Observation, Push
from dipn_jax.workspace import ROTATIONS, WORKSPACE

STANDOFF = 15
"""Distance in pixels from the contact back to a push's start. Source: DIPN's released code."""
CENTER_RANGE = (25, 199)
"""Pixels between which a predicted centre must stay, or the push is dropped. Source: DIPN's released code."""

TIP_CLEARANCE = 0.001
"""Metres between a fingertip and what it would otherwise press on."""
MIN_GRIP_DEPTH = 0.015
"""Smallest depth of an object between the fingers in metres, even where a finger then presses on something."""
LOW_OBJECT_RAISE = 0.004
"""Metres by which fingertips may stop short over an object that is too low for MIN_GRIP_DEPTH."""

APART_PIXELS = 8.0
"""Smallest distance in pixels between the centres of the best grasps, where several are wanted."""
SAME_GRASP_PIXELS = 10.0
"""Largest distance in pixels between the centres of two grasps that count as the same grasp."""
SAME_GRASP_ROTATIONS = 1
"""Largest difference in rotations (of 16) between two grasps that count as the same grasp."""

LEVEL_HEIGHT = 0.01
"""Metres: the step of heights by which `grasp_from_top` tells higher from lower."""

_OVERSAMPLE = 4  # pixels of contours drawn for each push


@functools.partial(jax.jit, static_argnames="count")
def sample_pushes(
    key: Key[Array, ""],
    observation: Observation,
    *,
    count: int,
    distance: Float[Array, ""] | Float[Array, " {count}"] | float,
) -> tuple[Push, Bool[jax.Array, " {count}"]]:
    """Sample the candidate pushes of one observation.

    Args:
      key: random key.
      observation: `[224, 224]` maps.
      count: number of candidates P.
      distance: metres, traced: one `[]`, or each candidate's own `[P]`.

    Returns:
      Pushes `[P]` and which of them are feasible `[P]` bool. Feasible ones come first, in random order;
      where there are fewer than `count`, the rest is flagged.
    """
    label, height = observation.label, observation.height
    on_contour = masks.contour(label != ABSENT).reshape(-1)
    noise = jax.random.uniform(key, on_contour.shape)
    _, index = jax.lax.top_k(jnp.where(on_contour, noise, -1.0), _OVERSAMPLE * count)
    width = label.shape[1]
    contact = geometry.pixels_to_metres(jnp.stack([index % width, index // width], -1))
    owner = jnp.maximum(label.reshape(-1)[index], 0)
    centers, _ = masks.mask_centers(label, observation.slots)
    toward = centers[owner] - contact
    angle = jnp.arctan2(toward[:, 1], toward[:, 0])
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    start = contact - STANDOFF * WORKSPACE.pixel * direction
    pixel = geometry.metres_to_pixels(start)
    inside = ((pixel >= fingers.START_RANGE[0]) & (pixel <= fingers.START_RANGE[1])).all(-1)
    free = jax.vmap(fingers.footprint_free, in_axes=(None, 0, 0))(height, start, angle)
    feasible = on_contour[index] & inside & free
    chosen = jnp.argsort(~feasible, stable=True)[:count]
    distances = jnp.broadcast_to(jnp.asarray(distance, jnp.float32), (count,))
    return Push(start[chosen], angle[chosen], distances), feasible[chosen]


def push_at(index: Int[Array, " 3"], distance: Float[Array, ""] | float) -> Push:
    """Return the push that starts at `index [3]` (rotation, row, col) and goes `distance []` metres."""
    index = jnp.asarray(index)
    start = geometry.pixels_to_metres(jnp.stack([index[2], index[1]], -1))
    return Push(start, index[0] * jnp.float32(2 * jnp.pi / ROTATIONS), jnp.float32(distance))


def push_index(push: Push) -> Int[jax.Array, " 3"]:
    """Return the pixel and direction nearest to a push: `[3]` int32 (rotation, row, col)."""
    pixel = jnp.round(geometry.metres_to_pixels(push.start))
    rotation = jnp.round(push.angle * (ROTATIONS / (2 * jnp.pi))) % ROTATIONS
    return jnp.stack([rotation, pixel[1], pixel[0]]).astype(jnp.int32)


def stays_inside(
    centers: Float[Array, "N 2"], area: Float[Array, " N"], motion: Float[Array, "N 3"]
) -> Bool[jax.Array, ""]:
    """Return whether every visible centre `[N, 2]` (metres) stays in CENTER_RANGE after `motion [N, 3]`."""
    pixel = geometry.metres_to_pixels(centers + motion[:, :2])
    before = geometry.metres_to_pixels(centers)
    low, high = CENTER_RANGE
    out = ((pixel < low) & (pixel < before)) | ((pixel > high) & (pixel > before))
    return ~jnp.any(out.any(-1) & (area > 0))


def grasp_at(index: Int[Array, "*b 3"], height: Float[Array, "H W"]) -> Grasp:
    """Return the grasp `[...]` of `index [..., 3]` (rotation, row, col) on a height map `[H, W]` (metres).

    The tips go to `fingers.grasp_height`. Where a finger would press on something on its way there they stop above it,
    but leave MIN_GRIP_DEPTH of the object between them at least, or rise LOW_OBJECT_RAISE over a low object.
    """
    index = jnp.asarray(index)
    rotation, row, col = index[..., 0], index[..., 1], index[..., 2]
    center = geometry.pixels_to_metres(jnp.stack([col, row], -1))
    angle = rotation * jnp.float32(2 * jnp.pi / ROTATIONS)
    local = height[row, col]
    goal, contact = fingers.grasp_height(local), fingers.under_fingers(height, center, angle) + TIP_CLEARANCE
    highest = jnp.maximum(local - MIN_GRIP_DEPTH, goal + LOW_OBJECT_RAISE)
    return Grasp(center, angle, jnp.maximum(goal, jnp.minimum(contact, highest)))


def grasp_index(grasp: Grasp) -> Int[jax.Array, "*b 3"]:
    """Return the index `[..., 3]` int32 (rotation, row, col) of a grasp: the inverse of `grasp_at`."""
    pixel = jnp.round(geometry.metres_to_pixels(grasp.center))
    rotation = jnp.round(grasp.angle * (ROTATIONS / (2 * jnp.pi))) % ROTATIONS
    return jnp.stack([rotation, pixel[..., 1], pixel[..., 0]], -1).astype(jnp.int32)


@functools.partial(jax.jit, static_argnames="count")
def random_grasps(key: Key[Array, ""], observation: Observation, *, count: int) -> Grasp:
    """Draw `count` grasps at uniformly random foreground pixels, each at one of the 16 angles."""
    pixel_key, angle_key = jax.random.split(key)
    noise = jax.random.uniform(pixel_key, (observation.label.size,))
    _, pixel = jax.lax.top_k(jnp.where(observation.label.reshape(-1) != ABSENT, noise, -1.0), count)
    width = observation.label.shape[1]
    rotation = jax.random.randint(angle_key, (count,), 0, ROTATIONS)
    return grasp_at(jnp.stack([rotation, pixel // width, pixel % width], -1), observation.height)


def sample_grasps(
    key: Key[Array, ""],
    observation: Observation,
    scores: Float[Array, "R H W"],
    *,
    count: int,
    guided: Float[Array, ""] | float,
    unsure: Float[Array, ""] | float,
) -> Grasp:
    """Draw `count` grasps: some with the highest scores, some with uncertain ones, the others at random.

    Args:
      key: random key.
      observation: `[H, W]` maps.
      scores: `[16, H, W]` in [0, 1].
      count: number of grasps.
      guided: share of grasps drawn in proportion to the squared odds of the score, traced.
      unsure: share drawn in proportion to the squared variance, (score x (1 - score))^2, traced.
    """
    kind_key, draw_key, random_key = jax.random.split(key, 3)
    kind = jax.random.uniform(kind_key, (count,))
    on = jnp.where(observation.label == ABSENT, -jnp.inf, 0.0)
    yes, no = jnp.log(scores + 1e-6), jnp.log1p(1e-6 - scores)

    def draw(k: jax.Array, u: jax.Array) -> jax.Array:
        weight = 2 * jnp.where(u < guided, yes - no, yes + no) + on
        flat = jnp.argmax(weight + jax.random.gumbel(k, weight.shape))
        return jnp.stack(jnp.unravel_index(flat, scores.shape)).astype(jnp.int32)

    index = jax.lax.map(lambda pair: draw(*pair), (jax.random.split(draw_key, count), kind))
    chosen, anywhere = grasp_at(index, observation.height), random_grasps(random_key, observation, count=count)

    def pick(one: jax.Array, other: jax.Array) -> jax.Array:
        return jnp.where((kind < guided + unsure).reshape(-1, *[1] * (one.ndim - 1)), one, other)

    return jax.tree.map(pick, chosen, anywhere)


def best_grasp(scores: Float[Array, "R H W"]) -> tuple[Int[jax.Array, " 3"], Float[jax.Array, ""]]:
    """Return the index `[3]` (rotation, row, col) of the best of scores `[16, H, W]`, and its score."""
    flat = jnp.argmax(scores)
    index = jnp.stack(jnp.unravel_index(flat, scores.shape)).astype(jnp.int32)
    return index, scores.reshape(-1)[flat]


def grasp_from_top(
    scores: Float[Array, "R H W"], height: Float[Array, "H W"], margin: Float[Array, ""] | float
) -> tuple[Int[jax.Array, " 3"], Float[jax.Array, ""]]:
    """Of the grasps within `margin` of the best, return the best on the highest object: index `[3]` and score.

    So an object is not pulled from under another.

    Args:
      scores: `[16, H, W]`.
      height: metres; what is within the same LEVEL_HEIGHT is as high.
      margin: by how much a score may be lower than the best; 0 is `best_grasp`.
    """
    near = scores >= scores.max() - margin
    level = jnp.where(near, jnp.floor(jnp.asarray(height) / LEVEL_HEIGHT), -jnp.inf)
    return best_grasp(jnp.where(near & (level == level.max()), scores, -jnp.inf))


def discount_missed(scores: Float[Array, "R H W"], missed: Int[Array, "M 3"]) -> Float[jax.Array, "R H W"]:
    """Halve scores `[16, H, W]` near grasps that missed, once for each of them.

    Args:
      scores: scores of grasps, now.
      missed: `[M, 3]` int32 (rotation, row, col) of grasps that missed on what is there now; -1: none.
    """
    missed = jnp.asarray(missed)
    half = ROTATIONS // 2  # a grasp turned by half a turn is the same grasp
    turned = jnp.abs((jnp.arange(ROTATIONS)[:, None] - missed[:, 0] + half // 2) % half - half // 2)
    alike = (turned <= SAME_GRASP_ROTATIONS) & (missed[:, 0] >= 0)
    away = geometry.view_grid(*scores.shape[1:]) - missed[:, None, None, :0:-1]
    near = jnp.linalg.norm(away, axis=-1) <= SAME_GRASP_PIXELS
    count = jnp.einsum("rm,mhw->rhw", alike.astype(scores.dtype), near.astype(scores.dtype))
    return jnp.minimum(scores, scores * 0.5**count)


def exclude_near(scores: Float[Array, "R H W"], grasp: Int[Array, " 3"]) -> Float[jax.Array, "R H W"]:
    """Return the scores with -1 for all grasps that are less than APART_PIXELS from a grasp `[3]`."""
    away = geometry.view_grid(*scores.shape[1:]) - jnp.asarray(grasp)[::-1][:2]
    return jnp.where(jnp.linalg.norm(away, axis=-1) < APART_PIXELS, -1.0, scores)


def best_grasps(scores: Float[Array, "R H W"], *, count: int) -> Int[jax.Array, "{count} 3"]:
    """Return the `count` best grasps by score, at least APART_PIXELS from one another."""

    def next_best(left: Array, _: None) -> tuple[Array, jax.Array]:
        index = best_grasp(left)[0]
        return exclude_near(left, index), index

    return jax.lax.scan(next_best, scores, None, length=count)[1]
