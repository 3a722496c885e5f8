"""DIPN's input: the scene moved rigidly so that a push starts at pixel (40, 112) and goes to +x."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from dipn_jax import geometry
from dipn_jax.networks import losses
from dipn_jax.sight import masks
from dipn_jax.structs import ABSENT, Array, Push, Pytree
from dipn_jax.workspace import GRIPPER, PUSH_STEPS, WORKSPACE

START_PIXEL = (40.0, 112.0)
"""Column and row of the start in the push frame."""
START_BOX = (40, 100, 65, 124)
"""First column and row, last column and row of the white box in M_p, the map of the push."""
PAPER_CROP = 60
"""Pixels along a side of the published crop of an object's mask, about its centre."""
HEIGHT_UNIT = 0.05
"""Metres that are 1 in a height channel."""
OUTLINE_DIRECTIONS = 32
"""Number of directions in which outlines are known, evenly from +x toward +y."""
OUTLINE_WINDOW = 96
"""Pixels around a centroid that are searched for an outline: no mask of one object reaches farther."""
_FAR_AWAY = 10.0
"""Metres, farther than any pixel."""


@dataclasses.dataclass(frozen=True)
class View:
    """Form in which a network is shown a push."""

    crop: int  # pixels of a crop's side
    stride: int  # pixels between its samples
    context: bool  # outlines, and crops that also show other objects, the sweep and heights, but no maps of the scene

    @property
    def crop_side(self) -> int:
        """Samples along a side of a crop."""
        return self.crop // self.stride

    @property
    def channels(self) -> int:
        """Channels of a crop."""
        return 5 if self.context else 1


PAPER = View(PAPER_CROP, 1, context=False)
"""View of the published network."""
COMPACT = View(64, 4, context=True)
"""View of the compact network; its coarse crops show what outlines do not: what lies on what, where others are."""


@flax.struct.dataclass
class PushInput(Pytree):
    """DIPN's input for one push, in the push frame.

    M is 224, C is `View.crop_side`, F is 1, D is 0; with `context`, M is 0, F is 5, D is OUTLINE_DIRECTIONS.
    """

    push_map: Float[Array, "*b M M"]  # M_p
    scene_map: Float[Array, "*b M M"]  # M_I, 1 on any object
    crops: Float[Array, "*b N C C F"]  # M_i about c_i; with `context` others, sweep, own height, others' height
    outlines: Float[Array, "*b N D 2"]  # metres from c_i: see `outlines`
    centers: Float[Array, "*b N 2"]  # c_i, metres from the start
    present: Bool[Array, "*b N"]  # objects in sight


def _sweep(xy: Float[jax.Array, "*b 2"], distance: float) -> Float[jax.Array, "*b"]:
    """Return 1 where the closed gripper passes, else 0; `xy` in metres from the start, push frame."""
    inside = (xy[..., 0] >= -GRIPPER.pad_width / 2) & (xy[..., 0] <= distance + GRIPPER.pad_width / 2)
    return (inside & (jnp.abs(xy[..., 1]) <= GRIPPER.push_width / 2)).astype(jnp.float32)


def push_ends(distance: Float[Array, "*b"]) -> Float[jax.Array, "*b 4"]:
    """Return start and end of pushes by `distance` metres, in units of the map's side."""
    origin = np.array(START_PIXEL, np.float32) / WORKSPACE.pixels
    end = origin[0] + distance / WORKSPACE.side
    fixed = [jnp.full_like(end, value) for value in (*origin, origin[1])]
    return jnp.stack([fixed[0], fixed[1], end, fixed[2]], -1)


def push_input(
    label: Int[Array, "H W"], height: Float[Array, "H W"], push: Push, *, slots: int, view: View
) -> tuple[PushInput, Float[jax.Array, "{slots} 2"]]:
    """Move the camera's maps into the frame of one push.

    Args:
      label: object slots, 224 x 224.
      height: metres, 224 x 224; used only with `context`.
      push: one push.
      slots: number of object slots.
      view: how to sample.

    Returns:
      The network's input, and the mask centroids in the workspace (metres).
    """
    centers, area = masks.mask_centers(label, slots)
    start_offset = np.array(START_PIXEL, np.float32)
    image = jnp.stack([label.astype(jnp.float32), height / HEIGHT_UNIT], -1) if view.context else label[..., None]

    def sample(local: jax.Array) -> jax.Array:
        there = geometry.rotate2d(local, push.angle) + push.start
        return geometry.sample_nearest(image, geometry.metres_to_pixels(there), ABSENT)

    if view.context:
        push_map = scene_map = jnp.zeros((0, 0))
    else:
        pixel = geometry.view_grid(WORKSPACE.pixels, WORKSPACE.pixels)
        scene_map = sample((pixel - start_offset) * WORKSPACE.pixel)[..., 0] != ABSENT
        col0, row0, col1, row1 = START_BOX
        col, row = pixel[..., 0], pixel[..., 1]
        push_map = (col >= col0) & (col <= col1) & (row >= row0) & (row <= row1)
    local_centers = geometry.rotate2d(centers - push.start, -push.angle)
    about = geometry.view_grid(view.crop_side, view.crop_side) - (view.crop_side - 1) / 2
    crop_local = local_centers[:, None, None] + about * view.stride * WORKSPACE.pixel
    crop = sample(crop_local)
    own = crop[..., 0] == jnp.arange(slots)[:, None, None]
    channels = [own]
    if view.context:
        other = (crop[..., 0] != ABSENT) & ~own
        channels += [other, _sweep(crop_local, PUSH_STEPS * 0.01), own * crop[..., 1], other * crop[..., 1]]
    inputs = PushInput(
        push_map.astype(jnp.float32),
        scene_map.astype(jnp.float32),
        jnp.stack([c.astype(jnp.float32) for c in channels], -1),
        outlines(label, height, push.angle, centers) if view.context else jnp.zeros((slots, 0, 2)),
        local_centers,
        area > 0,
    )
    return inputs, centers


def directions() -> Float[np.ndarray, "32 2"]:
    """Return unit vectors of the directions of outlines."""
    angle = np.arange(OUTLINE_DIRECTIONS) * 2 * np.pi / OUTLINE_DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)


def outlines(
    label: Int[Array, "H W"],
    height: Float[Array, "H W"],
    angle: Float[Array, ""] | float,
    centers: Float[Array, "N 2"],
) -> Float[jax.Array, "N 32 2"]:
    """Return support functions of the masks: how far each reaches from its centroid, in directions turned by `angle`.

    Args:
      label: object slots.
      height: metres.
      angle: radians.
      centers: metres, workspace (`masks.mask_centers`).

    Returns:
      Metres, to pixel centres, in each of the directions: of the whole mask, and of its part that is as high as the
      fingertips of a push. 0 where a mask is empty.
    """
    normal = geometry.rotate2d(directions(), angle)
    middle = (np.array(label.shape[::-1]) - 1) / 2
    corner = jnp.round(centers / WORKSPACE.pixel + middle - OUTLINE_WINDOW / 2).astype(jnp.int32)
    corner = jnp.clip(corner, 0, np.array(label.shape[::-1]) - OUTLINE_WINDOW)
    level = jnp.where(height > GRIPPER.push_tip, 2, 1)

    def reach(slot: jax.Array, at: jax.Array, center: Array) -> jax.Array:
        cut = lambda image: jax.lax.dynamic_slice(image, (at[1], at[0]), (OUTLINE_WINDOW, OUTLINE_WINDOW))  # noqa: E731
        tall = jnp.where(cut(label) == slot, cut(level), 0)
        x, y = ((jnp.arange(OUTLINE_WINDOW) + at[k] - middle[k]) * WORKSPACE.pixel - center[k] for k in range(2))
        found = []
        for mask in (tall >= 1, tall >= 2):
            high, low = jnp.where(mask, x, -_FAR_AWAY).max(-1), jnp.where(mask, x, _FAR_AWAY).min(-1)  # of each row
            across = jnp.maximum(high[:, None] * normal[:, 0], low[:, None] * normal[:, 0])
            farthest = jnp.where((high > -_FAR_AWAY)[:, None], across + y[:, None] * normal[:, 1], -_FAR_AWAY).max(0)
            found.append(jnp.where(farthest > -_FAR_AWAY / 2, farthest, 0.0))
        return jnp.stack(found, -1)

    return jax.vmap(reach)(jnp.arange(centers.shape[0]), corner, centers)


def over_batch(function: Callable[..., Any], *rows: Any) -> Any:
    """Apply `function` to each row of batched pytrees, inside jit or not.

    Rows are taken one after the other on a CPU, which keeps an image in the cache (2 times faster), else all at once.
    """
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda row: function(*row), rows)
    return jax.vmap(function)(*rows)


@functools.partial(jax.jit, static_argnames=("slots", "view"))
def push_inputs(
    labels: Int[Array, "B H W"], heights: Float[Array, "B H W"], pushes: Push, *, slots: int, view: View
) -> tuple[PushInput, Float[jax.Array, "B {slots} 2"]]:
    """Apply `push_input` to a batch: labels, heights and as many pushes."""
    return over_batch(functools.partial(push_input, slots=slots, view=view), labels, heights, pushes)


def mirror(inputs: PushInput) -> PushInput:
    """Return the same push seen in a mirror that contains its axis (batched or not).

    Row 112 of the maps is the axis and row 0 has no counterpart, so a flip shifts them by a row, which is rolled back;
    the directions of the outlines likewise.
    """
    axis = inputs.push_map.ndim - 2
    flip = lambda m: jnp.roll(jnp.flip(m, axis), 1, axis)  # noqa: E731
    return inputs.replace(
        push_map=flip(inputs.push_map),
        scene_map=flip(inputs.scene_map),
        crops=jnp.flip(inputs.crops, -3),
        outlines=jnp.roll(jnp.flip(inputs.outlines, -2), 1, -2),
        centers=inputs.centers * jnp.array([1.0, -1.0]),
    )


def mirror_motion(motion: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Return motions (push frame) as seen in the same mirror."""
    return motion * jnp.array([1.0, -1.0, -1.0])


def to_workspace(motion: Float[Array, "*b N 3"], angle: Float[Array, "*#b"]) -> Float[jax.Array, "*b N 3"]:
    """Turn network output (pixels, degrees, push frame) into metres and radians, workspace.

    `angle` is the direction of the push, in radians.
    """
    metric = motion / losses.PIXELS_DEGREES
    shift = geometry.rotate2d(metric[..., :2], angle[..., None])
    return jnp.concatenate([shift, metric[..., 2:]], -1)


def from_workspace(motion: Float[Array, "*b N 3"], angle: Float[Array, "*#b"]) -> Float[jax.Array, "*b N 3"]:
    """Return the inverse of `to_workspace`."""
    shift = geometry.rotate2d(motion[..., :2], -angle[..., None])
    return jnp.concatenate([shift, motion[..., 2:]], -1) * losses.PIXELS_DEGREES
