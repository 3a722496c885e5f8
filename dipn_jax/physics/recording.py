"""Traced bookkeeping of a rollout: set points, the fence's forces, sampled poses, what faults are judged by."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from dipn_jax import physics
from dipn_jax.physics import faults
from dipn_jax.structs import Array, Pytree, Scene, Trajectory
from dipn_jax.world.model import GRIPPER_DOF


@flax.struct.dataclass
class State(Pytree):
    """State that passes from one substep to the next."""

    qpos: Float[jax.Array, "*b Q"]  # the gripper's six, then seven an object: see world.model
    qvel: Float[jax.Array, "*b V"]  # six and six
    warmstart: Float[jax.Array, "*b V"]  # accelerations that the solver starts from
    full: Bool[Array, "*b"]  # contacts or geom pairs were left out
    depth: Float[Array, "*b"]  # metres: deepest contact


@flax.struct.dataclass
class Record(Pytree):
    """Record of a rollout so far."""

    poses: Float[Array, "*b S N 7"]  # metres and quaternions wxyz, workspace
    gripper: Float[Array, "*b S 5"]  # as Trajectory.target, as reached
    top: Float[Array, "*b"]  # m/s: highest speed of a present object
    stray: Float[Array, "*b"]  # metres: farthest that the hand was off its path
    broken: Bool[Array, "*b"]  # something was not finite
    deepest: Float[Array, "*b"]  # metres: contact, where depth counts


def fence_forces(mass: Float[Array, "B N"], state: State) -> Float[jax.Array, "B 6+6*N"]:
    """Return the fence's generalized forces `[B, 6 + 6 N]` on objects of `mass [B, N]`, which is 0 for empty slots."""
    position = state.qpos[:, GRIPPER_DOF:].reshape(*mass.shape, 7)[..., :2]
    velocity = state.qvel[:, GRIPPER_DOF:].reshape(*mass.shape, 6)[..., :2]
    force = jnp.zeros((*mass.shape, 6)).at[..., :2].set(physics.fence_force(mass, position, velocity))
    return jnp.pad(force.reshape(len(mass), -1), ((0, 0), (GRIPPER_DOF, 0)))


def control(trajectories: Trajectory, time: Float[Array, ""] | float) -> Float[jax.Array, "B 6"]:
    """Return actuator set points `[B, 6]` at `time`: linear between key frames, half the gap a finger."""

    def one(times: Array, targets: Array) -> jax.Array:
        index = jnp.clip((times <= time).sum() - 1, 0, len(times) - 2)
        span = jnp.maximum(times[index + 1] - times[index], 1e-9)
        weight = jnp.clip((time - times[index]) / span, 0.0, 1.0)
        pose = targets[index] * (1 - weight) + targets[index + 1] * weight
        return jnp.concatenate([pose[:4], pose[4:] / 2, pose[4:] / 2])

    return jax.vmap(one)(trajectories.time, trajectories.target)


def store(record: Record, state: State, now: Bool[Array, " S"]) -> Record:
    """Store the present state in the samples that are due; `now [S]` says which."""
    gripper, poses = state.qpos[:, :GRIPPER_DOF], state.qpos[:, GRIPPER_DOF:]
    gripper = jnp.concatenate([gripper[:, :4], gripper[:, 4:].sum(-1, keepdims=True)], -1)
    poses = poses.reshape(record.poses.shape[:1] + record.poses.shape[2:])
    return record.replace(
        poses=jnp.where(now[None, :, None, None], poses[:, None], record.poses),
        gripper=jnp.where(now[None, :, None], gripper[:, None], record.gripper),
    )


def velocity(state: State, scenes: Scene) -> Float[jax.Array, "B N 6"]:
    """Return the velocities of the objects `[B, N, 6]`."""
    return state.qvel[:, GRIPPER_DOF:].reshape(*scenes.shape.shape, 6)


def watch(record: Record, state: State, scenes: Scene, target: Float[Array, "B 6"], *, deep: Bool[Array, ""]) -> Record:
    """Note speeds, depths (if `deep`), what is not finite, and how far the hand is off its `target`."""
    linear = faults.speed(scenes, velocity(state, scenes))
    finite = jnp.isfinite(state.qpos).all(-1) & jnp.isfinite(state.qvel).all(-1)
    top = jnp.maximum(record.top, jnp.where(finite, linear.max(-1), 0.0))
    off = faults.off_path(state.qpos[:, :3], target[:, :3])
    stray = jnp.maximum(record.stray, jnp.where(finite, off, jnp.inf))
    deepest = jnp.maximum(record.deepest, jnp.where(finite & deep, state.depth, 0.0))
    return record.replace(top=top, stray=stray, broken=record.broken | ~finite, deepest=deepest)
