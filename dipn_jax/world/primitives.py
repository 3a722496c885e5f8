"""The three primitives, settle, push and grasp: each is a gripper trajectory and a way to read the result.

A primitive knows no engine; an engine knows no primitive. All functions broadcast over leading axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from dipn_jax import geometry
from dipn_jax.engine import Engine
from dipn_jax.structs import Array, Fault, Grasp, Outcome, Push, Rollout, Scene, Trajectory
from dipn_jax.system import forking
from dipn_jax.workspace import GRIPPER, PUSH_STEPS

CLEAR_HEIGHT = 0.30
"""Height in metres at which the gripper touches nothing."""
SETTLE_TIME = 2.5
"""Seconds that objects get to come to rest. Measured: 7 objects need 1.4, 10 need 1.8, 30 need 2.1 (p90)."""
FENCE_TIME = 1.5
"""Seconds of a drop during which a fence keeps objects in.

Measured: without it an object leaves the workspace in 20 % of drops of 10 objects, and in all of 30.
"""
RESETTLE_TIME = 0.6
"""Seconds that objects get to come to rest after an action."""
DESCEND_TIME = 0.4
"""Seconds in which the gripper comes down for a push, whose start is free."""
REACH_TIME = 0.8
"""Seconds in which it comes down for a grasp. Measured: in half of that, at 0.45 m/s, fingers knock objects aside."""
PUSH_SPEED = 0.1
"""Speed of a push in m/s."""
CLOSE_SPEED = 0.15
"""Speed of each finger as it closes, m/s; a step instead of a ramp throws objects."""
HOLD_TIME = 0.15
"""Seconds for which the closed fingers wait before the lift."""
LIFT_TIME = 0.5
"""Seconds of the lift."""
REST_TIME = 0.3
"""Seconds after an action before its last sample."""
TIPPED_ANGLE = np.deg2rad(45)
"""Radians by which an object must be tilted to count as tipped over."""
HELD_RISE = 0.5
"""Share of the lift that an object must rise to count as held."""


def _frames(times: Sequence[Float[Array, "*b"] | float], targets: list[Float[jax.Array, "*b 5"]]) -> Trajectory:
    """Return key frames from durations (seconds, first 0) and targets."""
    target = jnp.stack(targets, -2)
    lasting = [jnp.broadcast_to(jnp.asarray(t, jnp.float32), target.shape[:-2]) for t in times]
    return Trajectory(jnp.cumsum(jnp.stack(lasting, -1), -1), target)


def _pose(
    xy: Float[Array, "*b 2"], height: Float[Array, "*#b"] | float, yaw: Float[Array, "*#b"] | float, gap: float
) -> Float[jax.Array, "*b 5"]:
    xy = jnp.asarray(xy, jnp.float32)
    height, yaw, gap_ = jnp.broadcast_arrays(jnp.asarray(height), jnp.asarray(yaw), jnp.float32(gap))
    height, yaw, gap_ = (jnp.broadcast_to(v, xy.shape[:-1]) for v in (height, yaw, gap_))
    return jnp.stack([xy[..., 0], xy[..., 1], height, yaw, gap_], -1)


def parked_trajectory(batch: int, duration: float) -> Trajectory:
    """Keep the gripper above everything, out of the way, for `duration` seconds."""
    still = _pose(jnp.zeros((batch, 2)), jnp.float32(2.0), jnp.float32(0.0), GRIPPER.push_gap)
    return _frames([0.0, duration], [still, still])


def push_trajectory(push: Push) -> Trajectory:
    """Go down beside the object with the broad side forward, move straight on at PUSH_SPEED, go up again."""
    yaw = push.angle + np.pi / 2
    direction = jnp.stack([jnp.cos(push.angle), jnp.sin(push.angle)], -1)
    end = push.start + push.distance[..., None] * direction
    low, gap = GRIPPER.push_tip, GRIPPER.push_gap
    start_high, start_low = _pose(push.start, CLEAR_HEIGHT, yaw, gap), _pose(push.start, low, yaw, gap)
    end_low, end_high = _pose(end, low, yaw, gap), _pose(end, CLEAR_HEIGHT, yaw, gap)
    travel = jnp.asarray(push.distance, jnp.float32) / PUSH_SPEED
    times = (0.0, DESCEND_TIME, 0.1, travel, 0.1, DESCEND_TIME, REST_TIME)
    return _frames(times, [start_high, start_low, start_low, end_low, end_low, end_high, end_high])


def push_samples(*, longest: float = PUSH_STEPS * 0.01) -> Float[np.ndarray, " 12"]:
    """Return the sampled times in seconds: at each centimetre up to 10, and at rest after `longest` metres."""
    begin = DESCEND_TIME + 0.1
    travel = begin + np.arange(PUSH_STEPS + 1) * 0.01 / PUSH_SPEED
    return np.append(travel, begin + longest / PUSH_SPEED + 0.1 + DESCEND_TIME + REST_TIME)


def grasp_trajectory(grasp: Grasp) -> Trajectory:
    """Go down with open fingers, close them, lift."""
    g = GRIPPER
    high = _pose(grasp.center, jnp.maximum(grasp.height + 0.1, 0.2), grasp.angle, g.stroke)
    low_open = _pose(grasp.center, grasp.height, grasp.angle, g.stroke)
    low_shut = _pose(grasp.center, grasp.height, grasp.angle, 0.0)
    top_shut = _pose(grasp.center, grasp.height + g.lift, grasp.angle, 0.0)
    times = [0.0, REACH_TIME, 0.05, g.stroke / 2 / CLOSE_SPEED, HOLD_TIME, LIFT_TIME, REST_TIME]
    return _frames(times, [high, low_open, low_open, low_shut, low_shut, top_shut, top_shut])


def grasp_samples() -> Float[np.ndarray, " 2"]:
    """Return the sampled times in seconds, at the start and at the end of the lift; multiples of the control period."""
    end = REACH_TIME + 0.05 + GRIPPER.stroke / 2 / CLOSE_SPEED + HOLD_TIME + LIFT_TIME + REST_TIME
    return np.array([0.0, np.ceil(end * 100) / 100])


def settle(
    engine: Engine, scenes: Scene, poses: Float[Array, "B N 7"], *, duration: float = SETTLE_TIME, fence: float = 0.0
) -> Rollout:
    """Let the scenes come to rest; one sample, at the end. For `fence` see `Engine.simulate`."""
    forking.check()
    still, end = parked_trajectory(len(scenes.shape), duration), np.array([duration])
    return engine.simulate(scenes, poses, still, end, settle=True, fence=fence)


def push(
    engine: Engine,
    scenes: Scene,
    poses: Float[Array, "B N 7"],
    pushes: Push,
    *,
    longest: float = PUSH_STEPS * 0.01,
) -> Rollout:
    """Execute one push of at most `longest` metres per scene; 12 samples: at each centimetre, and at rest."""
    forking.check()
    rollout = engine.simulate(scenes, poses, push_trajectory(pushes), push_samples(longest=longest), settle=True)
    over = tipped(rollout.poses[..., 0, :, 3:], rollout.poses[..., -1, :, 3:]) & (scenes.shape >= 0)
    return rollout.replace(fault=rollout.fault | jnp.where(over.any(-1), Fault.TIPPED, 0))


def tipped(before: Float[Array, "*b 4"], after: Float[Array, "*b 4"]) -> Bool[jax.Array, "*b"]:
    """Return which objects with quaternions (wxyz) have been tipped by over 45 degrees."""
    up = [geometry.quat_to_matrix(jnp.asarray(quat))[..., 2, :] for quat in (before, after)]
    return (up[0] * up[1]).sum(-1) < np.cos(TIPPED_ANGLE)


def grasp(engine: Engine, scenes: Scene, poses: Float[Array, "B N 7"], grasps: Grasp) -> tuple[Rollout, Outcome]:
    """Execute one grasp per scene; two samples: before, and after the lift."""
    forking.check()
    rollout = engine.simulate(scenes, poses, grasp_trajectory(grasps), grasp_samples())
    return rollout, grasp_outcome(scenes, rollout)


def grasp_outcome(scenes: Scene, rollout: Rollout) -> Outcome:
    """Find which objects rose with the hand between the first and the last sample."""
    rise = rollout.poses[..., -1, :, 2] - rollout.poses[..., 0, :, 2]
    held = (scenes.shape >= 0) & (rise > HELD_RISE * GRIPPER.lift)
    return Outcome(held, held.any(-1))  # type: ignore[arg-type]  # an np.bool where there is no batch axis
