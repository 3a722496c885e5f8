"""Faults of a simulation: one set of rules for every engine."""

from __future__ import annotations

from types import ModuleType

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from dipn_jax.structs import Array, Fault, Scene
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import shapes

MAX_SPEED = 5.0
"""m/s that the centre of an object may reach; a drop from 1.2 m ends at 4.9 m/s."""
REST_SPEED = 0.02
"""m/s (and, times the size of an object, the bound on rotation) below which a scene is at rest."""
MAX_SINK = 0.004
"""Metres that the lowest corner of an object may be under the table, or an object inside another."""
MAX_DEPTH = 0.01
"""Metres that a contact may be deep during a rollout, looked at once a control period. While a fence is up it does not
count: impacts press heaps together as they fall (30 objects: 14 mm at half of the drops), and they part again. Measured
on 1 to 30 objects: pushes at most 3.6 mm, 99 % of grasps at most 5 mm, the worst (a finger holds the hand up) 22 mm.
"""
GRACE_TIME = 0.1
"""Seconds from the start in which a contact may be deeper than MAX_DEPTH: an object that is set down inside another is
pushed out (one of the hard cases: 16 mm, for 0.03 s). Depth at the end counts however soon that is.
"""
MAX_MISS = 0.01
"""Metres by which a gripper may miss its last set point."""
MAX_STRAY = 0.015
"""Metres by which a gripper may be off its path during a rollout; measured: at most 10 mm free (turning points), 24 mm
and more on top of an object.
"""


def speed(scenes: Scene, velocity: Float[Array, "B N 6"], *, xp: ModuleType = jnp) -> Float[Array, "B N"]:
    """Return the speed `[B, N]` (m/s) of the centres of objects with `velocity [B, N, 6]`; 0 for empty slots."""
    return xp.where(scenes.shape >= 0, xp.sqrt((velocity[..., :3] ** 2).sum(-1)), 0.0)


def off_path(hand: Float[Array, "B 3"], target: Float[Array, "B 3"], *, xp: ModuleType = jnp) -> Float[Array, " B"]:
    """Return the largest difference `[B]` (metres, along an axis) of `hand [B, 3]` and its `target [B, 3]`."""
    return xp.abs(hand - target).max(-1)


def _fastest(scenes: Scene, velocity: Float[Array, "B N 6"], xp: ModuleType) -> Float[Array, " B"]:
    """Return an upper bound `[B]` (m/s) of the speed of any point of any object."""
    radius = xp.linalg.norm(scenes.size, axis=-1) / 2
    spin = xp.where(scenes.shape >= 0, xp.linalg.norm(velocity[..., 3:], axis=-1) * radius, 0.0)
    return xp.maximum(speed(scenes, velocity, xp=xp), spin).max(-1)


def codes(
    scenes: Scene,
    position: Float[Array, "B N 7"],
    velocity: Float[Array, "B N 6"],
    hand: Float[Array, "B 3"],
    target: Float[Array, "B 3"],
    *,
    top: Float[Array, " B"],
    stray: Float[Array, " B"],
    broken: Bool[Array, " B"],
    full: Bool[Array, " B"],
    depth: Float[Array, " B"],
    deepest: Float[Array, " B"],
    settle: Bool[Array, ""] | bool,
    xp: ModuleType = jnp,
) -> Int[Array, " B"]:
    """Return fault codes at the end of a rollout.

    Args:
      scenes: `[B, N]`.
      position: `[B, N, 7]` poses, metres.
      velocity: `[B, N, 6]` linear and angular.
      hand: `[B, 3]` metres: where the hand is.
      target: `[B, 3]` metres: where it should be.
      top: `[B]` m/s: highest speed of a centre during the rollout.
      stray: `[B]` metres: farthest that the hand was off its path.
      broken: `[B]` bool: something was not finite.
      full: `[B]` bool: contacts, or pairs of geoms, were left out.
      depth: `[B]` metres: deepest contact now.
      deepest: `[B]` metres: deepest contact after GRACE_TIME and while no fence was up.
      settle: whether everything has to be at rest.
      xp: numpy or jax.numpy.

    Returns:
      Bits of `Fault`.
    """
    present = scenes.shape >= 0
    outside = (xp.abs(position[..., :2]) > WORKSPACE.half).any(-1) & present
    sunk = (shapes.lowest_corner(scenes.shape, scenes.size, position, xp=xp) < -MAX_SINK) & present
    finite = xp.isfinite(xp.where(present[..., None], position, 0.0)).all((1, 2))
    flags = (
        (Fault.NON_FINITE, broken | ~finite),
        (Fault.CAPACITY, full),
        (Fault.UNSETTLED, settle & (_fastest(scenes, velocity, xp) > REST_SPEED)),
        (Fault.OUTSIDE, outside.any(-1)),
        (Fault.SPEED, top > MAX_SPEED),
        (Fault.PENETRATION, sunk.any(-1) | (depth > MAX_SINK) | (deepest > MAX_DEPTH)),
        (Fault.GRIPPER_SHORT, ~((off_path(hand, target, xp=xp) <= MAX_MISS) & (stray <= MAX_STRAY))),
    )
    return sum((xp.where(where, bit, 0) for bit, where in flags), xp.zeros(len(present), xp.int32))
