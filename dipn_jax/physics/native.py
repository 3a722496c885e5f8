"""MuJoCo C on all CPU cores, through `mujoco.batch`. The reference that the other engine is held against."""

from __future__ import annotations

import concurrent.futures
import os

import jax
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from dipn_jax import model, physics, shapes
from dipn_jax.model import GRIPPER_DOF, PhysicsConfig
from dipn_jax.structs import Array, Fault, Rollout, Scene, Trajectory
from dipn_jax.workspace import GRIPPER, WORKSPACE

DEFAULTS = PhysicsConfig()


class NativeEngine:
    """See `physics.Engine`. Results do not depend on the number of threads."""

    name = "native"

    def __init__(self, config: PhysicsConfig = DEFAULTS, *, threads: int | None = None) -> None:
        self.config, self.substeps = config, physics.substeps(config)
        self.threads = threads or os.cpu_count() or 1

    def simulate(
        self, scenes: Scene, poses: Array, trajectories: Trajectory, samples: Array, *, settle: bool = False
    ) -> Rollout:
        """See `physics.Engine.simulate`; arrays in, numpy arrays out."""
        scenes, trajectories = jax.tree.map(np.asarray, (scenes, trajectories))
        poses, instants = np.asarray(poses), np.asarray(samples)
        packed, slots = _pack(scenes, poses)
        models = self._compile(packed)
        sims = mujoco_batch.Batch(models[0], nsim=len(models), nthread=self.threads)
        sims.set_models(models)
        watch = _Watch(packed, sims)
        sims.qpos[:, GRIPPER_DOF:] = np.take_along_axis(poses, slots[..., None], 1).reshape(len(models), -1)
        sims.qpos[:, :GRIPPER_DOF] = _controls(trajectories, 0.0)
        ticks = np.round(instants / physics.CONTROL_PERIOD).astype(int)
        stored_poses, stored_gripper = [], []
        for tick in range(int(ticks[-1]) + 1):
            for _ in range(int((ticks == tick).sum())):
                stored_poses.append(_unpack(sims.qpos[:, GRIPPER_DOF:], poses, slots, packed.shape >= 0))
                stored_gripper.append(_gripper(sims.qpos))
            if tick < ticks[-1]:
                sims.ctrl[:] = _controls(trajectories, tick * physics.CONTROL_PERIOD + GRIPPER.lag)
                try:
                    sims.step(nstep=self.substeps)
                except mujoco_batch.SimulationError as error:
                    watch.raised(error.ids)
                watch.tick()
        target = _controls(trajectories, float(instants[-1]))
        fault = watch.codes(sims, target, settle)
        rollout = np.stack(stored_poses, 1).astype(np.float32)
        return Rollout(rollout, np.stack(stored_gripper, 1).astype(np.float32), fault)

    def _compile(self, scenes: Scene) -> list[mujoco.MjModel]:
        library = model.mesh_library(scenes)

        def one(i: int) -> mujoco.MjModel:
            scene = jax.tree.map(lambda leaf: leaf[i], scenes)
            return mujoco.MjModel.from_xml_string(model.mjcf(scene, config=self.config, library=library))

        with concurrent.futures.ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(one, range(len(scenes.shape))))


class _Watch:
    """Collects faults while a batch runs."""

    def __init__(self, scenes: Scene, sims: mujoco_batch.Batch) -> None:
        self.shape, self.size = scenes.shape, scenes.size
        self.present, self.radius = scenes.shape >= 0, np.linalg.norm(scenes.size, axis=-1) / 2
        self.sims = sims
        self.broken = np.zeros(len(self.present), bool)
        self.top = np.zeros(len(self.present))
        self.speed = np.zeros(self.present.shape)

    def raised(self, ids: np.ndarray) -> None:
        self.broken[ids] = True

    def tick(self) -> None:
        velocity = np.array(self.sims.qvel[:, GRIPPER_DOF:]).reshape(*self.present.shape, 6)
        linear = np.linalg.norm(velocity[..., :3], axis=-1)
        angular = np.linalg.norm(velocity[..., 3:], axis=-1) * self.radius
        self.speed = np.where(self.present, np.maximum(linear, angular), 0.0)
        finite = np.isfinite(self.speed).all(-1)
        self.broken |= ~finite
        self.top = np.maximum(self.top, np.where(finite, np.where(self.present, linear, 0.0).max(-1), 0.0))

    def codes(self, sims: mujoco_batch.Batch, target: np.ndarray, settle: bool) -> np.ndarray:
        """Fault codes `[B]` at the end of a rollout."""
        bad = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]
        full = [mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL]
        warning = np.asarray(sims.warning)[..., 1]  # (last info, count)
        position = np.array(sims.qpos[:, GRIPPER_DOF:]).reshape(*self.present.shape, 7)
        outside = (np.abs(position[..., :2]) > WORKSPACE.half).any(-1) & self.present
        lowest = shapes.lowest_corner(self.shape, self.size, position, xp=np)
        sunk = (lowest < -physics.MAX_SINK) & self.present
        short = np.abs(np.asarray(sims.qpos)[:, :3] - target[:, :3]).max(-1) > physics.MAX_SHORT
        code = np.zeros(len(position), np.int32)
        broken = self.broken | (warning[:, [int(w) for w in bad]] > 0).any(-1) | ~np.isfinite(position).all((1, 2))
        for bit, where in (
            (Fault.NON_FINITE, broken),
            (Fault.CAPACITY, (warning[:, [int(w) for w in full]] > 0).any(-1)),
            (Fault.UNSETTLED, settle & (self.speed.max(-1) > physics.REST_SPEED)),
            (Fault.OUTSIDE, outside.any(-1)),
            (Fault.SPEED, self.top > physics.MAX_SPEED),
            (Fault.PENETRATION, sunk.any(-1)),
            (Fault.SHORT, short),
        ):
            code |= np.where(where, bit, 0).astype(np.int32)
        return code


def _pack(scenes: Scene, poses: np.ndarray) -> tuple[Scene, np.ndarray]:
    """Present objects first, and only as many slots as the fullest scene needs; `slots [B, n]` says which."""
    present = scenes.shape >= 0
    n = max(1, int(present.sum(-1).max()))
    slots = np.argsort(~present, axis=-1, kind="stable")[:, :n]

    def take(leaf: np.ndarray) -> np.ndarray:
        return np.take_along_axis(leaf, slots.reshape(slots.shape + (1,) * (leaf.ndim - 2)), 1)

    return jax.tree.map(take, scenes), slots


def _unpack(qpos: np.ndarray, poses: np.ndarray, slots: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Object poses `[B, N, 7]` in the caller's slots; empty slots keep their pose (as bodies they just fall)."""
    out = np.array(poses)
    fresh = np.array(qpos).reshape(*slots.shape, 7).astype(out.dtype)
    old = np.take_along_axis(out, slots[..., None], 1)
    np.put_along_axis(out, slots[..., None], np.where(present[..., None], fresh, old), 1)
    return out


def _controls(trajectories: Trajectory, time: float) -> np.ndarray:
    """Actuator set points `[B, 6]` at `time`: linear between key frames, gap split over both fingers."""
    times, targets = trajectories.time, trajectories.target
    index = np.clip((times <= time).sum(-1) - 1, 0, times.shape[1] - 2)
    rows = np.arange(len(times))
    t0, t1 = times[rows, index], times[rows, index + 1]
    weight = np.clip((time - t0) / np.maximum(t1 - t0, 1e-9), 0.0, 1.0)[:, None]
    pose = targets[rows, index] * (1 - weight) + targets[rows, index + 1] * weight
    return np.concatenate([pose[:, :4], pose[:, 4:] / 2, pose[:, 4:] / 2], -1)


def _gripper(qpos: np.ndarray) -> np.ndarray:
    return np.concatenate([qpos[:, :4], qpos[:, 4:5] + qpos[:, 5:6]], -1)
