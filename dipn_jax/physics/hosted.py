"""Bookkeeping of a rollout on the host, for engines that step whole batches from there, tick by tick."""

from __future__ import annotations

from typing import Protocol

import jax
import mujoco
import numpy as np

from dipn_jax import physics
from dipn_jax.physics import faults
from dipn_jax.structs import Rollout, Scene, Trajectory
from dipn_jax.workspace import GRIPPER
from dipn_jax.world.model import GRIPPER_DOF

_NOT_FINITE_WARNINGS = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]
"""Warnings of MuJoCo that something is not finite, or huge."""
_FULL_WARNINGS = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}FULL")) for name in ("CONTACT", "CNSTR")]
"""Warnings of MuJoCo that contacts or constraints were left out."""


class State(Protocol):
    """The state of a batch of simulations of the gripper and N objects."""

    qpos: np.ndarray  # [B, 6 + 7 N]
    qvel: np.ndarray  # [B, 6 + 6 N]

    @property
    def warning(self) -> np.ndarray:
        """Warnings of each kind of mjtWarning: (last info, count) `[B, W, 2]`."""
        ...

    def last_depths(self) -> np.ndarray:
        """Return the deepest contact `[B]` in metres of the last step, without those among objects asleep."""
        ...

    def depths(self) -> np.ndarray:
        """Return the deepest contact `[B]` in metres now."""
        ...


class Worlds(State, Protocol):
    """A batch that is stepped from the host."""

    ctrl: np.ndarray  # [B, 6]
    qfrc_applied: np.ndarray  # [B, 6 + 6 N]

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        """Simulate one control period; returns which simulations (indices) failed, and which ran out of memory."""
        ...


def follow(
    sims: Worlds,
    scenes: Scene,
    slots: np.ndarray,
    poses: np.ndarray,
    trajectories: Trajectory,
    samples: np.ndarray,
    *,
    settle: bool,
    fence: float,
) -> Rollout:
    """Run `sims` along `trajectories`; `scenes` and `slots` are from `pack`, the rest as in `Engine.simulate`."""
    present = np.asarray(scenes.shape >= 0)
    mass = np.where(present, scenes.mass, 0.0)
    ticks = np.round(samples / physics.CONTROL_PERIOD).astype(int)
    last = int(ticks[-1])
    times = np.arange(last + 1) * physics.CONTROL_PERIOD
    ahead, now = (controls(trajectories, t) for t in (times + GRIPPER.lag, times))
    watch, stored = Watch(scenes, sims), []
    for tick in range(last + 1):
        if tick in ticks:
            state = unpack(sims.qpos[:, GRIPPER_DOF:], poses, slots, present), gripper(sims.qpos)
            stored += [state] * int((ticks == tick).sum())
        if tick < last:
            sims.ctrl[:] = ahead[tick]
            if fence:
                apply_fence(sims, mass, up=times[tick] < fence)
            watch.raised(*sims.advance())
            watch.tick(now[tick + 1], deep=times[tick] >= max(fence, faults.GRACE_TIME))
    fault = watch.codes(now[last], settle)
    rollout, hand = (np.stack(part, 1).astype(np.float32) for part in zip(*stored, strict=True))
    return Rollout(rollout, hand, fault)


class Watch:
    """Collects faults while a batch runs. A scene that was not finite once counts as broken until the end."""

    def __init__(self, scenes: Scene, sims: State) -> None:
        self.scenes, self.sims = scenes, sims
        batch, slots = scenes.shape.shape
        self.broken, self.full = np.zeros((2, batch), bool)
        self.fastest = np.zeros((batch, slots))  # (m/s)^2: highest so far
        self.off = np.zeros((batch, 3))  # metres: farthest that the hand was off its path
        self.deepest = np.zeros(batch)  # metres: contact, where depth counts

    def raised(self, failed: np.ndarray, full: np.ndarray) -> None:
        """Note simulations that the engine gave up."""
        self.broken[failed], self.full[full] = True, True

    def velocity(self) -> np.ndarray:
        """Return the velocities of the objects `[B, N, 6]`."""
        return np.asarray(self.sims.qvel)[:, GRIPPER_DOF:].reshape(*self.scenes.shape.shape, 6)

    def tick(self, target: np.ndarray, *, deep: bool) -> None:
        """Note speeds, depths (if `deep`) and how far the hand is off its `target [B, 6]`."""
        linear = self.velocity()[..., :3]
        np.maximum(self.fastest, np.einsum("bnk,bnk->bn", linear, linear), out=self.fastest)
        np.maximum(self.off, np.abs(np.asarray(self.sims.qpos)[:, :3] - target[:, :3]), out=self.off)
        if deep:
            np.fmax(self.deepest, self.sims.last_depths(), out=self.deepest)

    def codes(self, target: np.ndarray, settle: bool) -> np.ndarray:
        """Return fault codes `[B]` at the end of a rollout."""
        warning = np.asarray(self.sims.warning)[..., 1]  # (last info, count)
        qpos = np.array(self.sims.qpos)
        present = self.scenes.shape >= 0
        finite = np.isfinite(self.fastest)
        stray = self.off.max(-1)
        codes = faults.codes(
            self.scenes,
            qpos[:, GRIPPER_DOF:].reshape(*present.shape, 7),
            self.velocity(),
            qpos[:, :3],
            target[:, :3],
            top=np.sqrt(np.where(present & finite, self.fastest, 0.0)).max(-1),
            stray=np.where(np.isfinite(stray), stray, np.inf),
            broken=self.broken | (present & ~finite).any(-1) | (warning[:, _NOT_FINITE_WARNINGS] > 0).any(-1),
            full=self.full | (warning[:, _FULL_WARNINGS] > 0).any(-1),
            depth=np.where(self.broken, 0.0, self.sims.depths()),
            deepest=self.deepest,
            settle=settle,
            xp=np,
        )
        return np.asarray(codes)


def pack(scenes: Scene) -> tuple[Scene, np.ndarray]:
    """Return scenes with present objects first and only the slots that the fullest scene needs, and which `[B, n]`."""
    present = scenes.shape >= 0
    n = max(1, int(present.sum(-1).max()))
    slots = np.argsort(~present, axis=-1, kind="stable")[:, :n]

    def take(leaf: np.ndarray) -> np.ndarray:
        return np.take_along_axis(leaf, slots.reshape(slots.shape + (1,) * (leaf.ndim - 2)), 1)

    return jax.tree.map(take, scenes), slots


def unpack(qpos: np.ndarray, poses: np.ndarray, slots: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return object poses `[B, N, 7]` in the caller's slots; empty slots keep their pose (as bodies they just fall)."""
    out = np.array(poses)
    fresh = np.array(qpos).reshape(*slots.shape, 7).astype(out.dtype)
    old = np.take_along_axis(out, slots[..., None], 1)
    np.put_along_axis(out, slots[..., None], np.where(present[..., None], fresh, old), 1)
    return out


def apply_fence(sims: Worlds, mass: np.ndarray, *, up: bool) -> None:
    """Apply the fence's forces for the next control period; none after it has been taken away."""
    shape = mass.shape
    position = np.asarray(sims.qpos)[:, GRIPPER_DOF:].reshape(*shape, 7)[..., :2]
    velocity = np.asarray(sims.qvel)[:, GRIPPER_DOF:].reshape(*shape, 6)[..., :2]
    force = np.zeros((*shape, 6))
    if up:
        force[..., :2] = physics.fence_force(mass, position, velocity, xp=np)
    sims.qfrc_applied[:, GRIPPER_DOF:] = force.reshape(len(force), -1)


def controls(trajectories: Trajectory, time: np.ndarray) -> np.ndarray:
    """Return actuator set points `[T, B, 6]` at `time [T]`: linear between key frames, half the gap a finger."""
    times, targets = trajectories.time, trajectories.target
    when = time[:, None]
    index = np.clip((times <= when[..., None]).sum(-1) - 1, 0, times.shape[1] - 2)
    rows = np.arange(len(times))
    t0, t1 = times[rows, index], times[rows, index + 1]
    weight = np.clip((when - t0) / np.maximum(t1 - t0, 1e-9), 0.0, 1.0)[..., None]
    pose = targets[rows, index] * (1 - weight) + targets[rows, index + 1] * weight
    return np.concatenate([pose[..., :4], pose[..., 4:] / 2, pose[..., 4:] / 2], -1)


def gripper(qpos: np.ndarray) -> np.ndarray:
    """Return the gripper `[B, 5]` as in `Rollout.gripper`, from generalized positions `[B, 6 + 7 N]`."""
    return np.concatenate([qpos[:, :4], qpos[:, 4:5] + qpos[:, 5:6]], -1)
