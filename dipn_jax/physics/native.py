"""MuJoCo C on all CPU cores, through `mujoco.batch`. The reference that the other engine is held against."""

from __future__ import annotations

import collections
import concurrent.futures
import os
import threading

import jax
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from dipn_jax import model, physics
from dipn_jax.model import GRIPPER_DOF, PhysicsConfig
from dipn_jax.physics import faults
from dipn_jax.structs import Array, Rollout, Scene, Trajectory
from dipn_jax.workspace import GRIPPER

DEFAULTS = PhysicsConfig()
_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]
_FULL = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}FULL")) for name in ("CONTACT", "CNSTR")]
MODELS_KEPT = 256
"""Compiled models an engine remembers, about 0.1 MB each."""


class NativeEngine:
    """See `physics.Engine`. Results do not depend on the number of threads."""

    name = "native"

    def __init__(self, config: PhysicsConfig = DEFAULTS, *, threads: int | None = None) -> None:
        self.config, self.substeps = config, physics.substeps(config)
        self.threads = threads or os.cpu_count() or 1
        self._stopped, self._building, self._stepping = threading.Event(), threading.Lock(), threading.Lock()
        self._library: dict[int, np.ndarray] = {}  # by number of objects: the most meshes of each class met so far
        self._models: collections.OrderedDict[bytes, mujoco.MjModel] = collections.OrderedDict()

    def simulate(
        self,
        scenes: Scene,
        poses: Array,
        trajectories: Trajectory,
        samples: Array,
        *,
        settle: bool = False,
        fence: float = 0.0,
    ) -> Rollout:
        """See `physics.Engine.simulate`; arrays in, numpy arrays out."""
        scenes, trajectories = jax.tree.map(np.asarray, (scenes, trajectories))
        poses, instants = np.asarray(poses), np.asarray(samples)
        packed, slots = _pack(scenes, poses)
        with self._building:
            models = self._compile(packed)
        sims = mujoco_batch.Batch(models[0], nsim=len(models), nthread=self.threads)
        sims.set_models(models)
        watch = _Watch(packed, sims)
        sims.qpos[:, GRIPPER_DOF:] = np.take_along_axis(poses, slots[..., None], 1).reshape(len(models), -1)
        sims.qpos[:, :GRIPPER_DOF] = _controls(trajectories, 0.0)
        ticks = np.round(instants / physics.CONTROL_PERIOD).astype(int)
        present = packed.shape >= 0
        mass = np.where(present, packed.mass, 0.0)
        stored_poses, stored_gripper = [], []
        for tick in range(int(ticks[-1]) + 1):
            for _ in range(int((ticks == tick).sum())):
                stored_poses.append(_unpack(sims.qpos[:, GRIPPER_DOF:], poses, slots, present))
                stored_gripper.append(_gripper(sims.qpos))
            if tick < ticks[-1]:
                sims.ctrl[:] = _controls(trajectories, tick * physics.CONTROL_PERIOD + GRIPPER.lag)
                if fence:
                    _hold_in(sims, mass, up=tick * physics.CONTROL_PERIOD < fence)
                self._step(sims, watch)
        target = _controls(trajectories, float(instants[-1]))
        fault = watch.codes(target, settle)
        rollout = np.stack(stored_poses, 1).astype(np.float32)
        return Rollout(rollout, np.stack(stored_gripper, 1).astype(np.float32), fault)

    def _step(self, sims: mujoco_batch.Batch, watch: _Watch) -> None:
        """One control period. The lock is held no longer, so that batches of other threads go on beside this one."""
        if self._stopped.is_set():
            raise physics.Stopped
        try:
            with self._stepping:
                sims.step(nstep=self.substeps)
        except mujoco_batch.SimulationError as error:
            watch.raised(error.ids)
        watch.tick()

    def stop(self) -> None:
        """See `physics.Engine.stop`."""
        self._stopped.set()

    def _compile(self, scenes: Scene) -> list[mujoco.MjModel]:
        """One model a scene; that of a scene met a short while ago (it settled, now it is pushed) is at hand."""
        slots = scenes.shape.shape[1]
        library = np.maximum(model.mesh_library(scenes), self._library.get(slots, 0))
        self._library[slots] = library

        def compiled(i: int) -> mujoco.MjModel:
            scene = jax.tree.map(lambda leaf: leaf[i], scenes)
            return mujoco.MjModel.from_xml_string(model.mjcf(scene, config=self.config, library=library))

        physical = (scenes.shape, scenes.size, scenes.mass, scenes.friction)
        keys = [b"".join(leaf[i].tobytes() for leaf in physical) + library.tobytes() for i in range(len(scenes.shape))]
        missing = {key: i for i, key in enumerate(keys) if key not in self._models}
        with concurrent.futures.ThreadPoolExecutor(self.threads) as pool:
            self._models.update(zip(missing, pool.map(compiled, missing.values()), strict=True))
        models = [self._models[key] for key in keys]
        while len(self._models) > MODELS_KEPT:
            self._models.popitem(last=False)
        return models


class _Watch:
    """Collects faults while a batch runs."""

    def __init__(self, scenes: Scene, sims: mujoco_batch.Batch) -> None:
        self.scenes, self.sims = scenes, sims
        self.broken = np.zeros(len(scenes.shape), bool)
        self.top = np.zeros(len(scenes.shape))

    def raised(self, ids: np.ndarray) -> None:
        self.broken[ids] = True

    def velocity(self) -> np.ndarray:
        """Of the objects `[B, N, 6]`."""
        return np.array(self.sims.qvel[:, GRIPPER_DOF:]).reshape(*self.scenes.shape.shape, 6)

    def tick(self) -> None:
        linear, _ = faults.speeds(self.scenes, self.velocity(), xp=np)
        finite = np.isfinite(linear).all(-1)
        self.broken |= ~finite
        self.top = np.maximum(self.top, np.where(finite, linear.max(-1), 0.0))

    def codes(self, target: np.ndarray, settle: bool) -> np.ndarray:
        """Fault codes `[B]` at the end of a rollout."""
        warning = np.asarray(self.sims.warning)[..., 1]  # (last info, count)
        qpos = np.array(self.sims.qpos)
        return faults.codes(
            self.scenes,
            qpos[:, GRIPPER_DOF:].reshape(*self.scenes.shape.shape, 7),
            self.velocity(),
            qpos[:, :3],
            target[:, :3],
            top=self.top,
            broken=self.broken | (warning[:, _BAD] > 0).any(-1),
            full=(warning[:, _FULL] > 0).any(-1),
            depth=self.depths(),
            settle=settle,
            xp=np,
        )

    def depths(self) -> np.ndarray:
        """Deepest contact `[B]` in metres, at the present state."""
        whole = np.flatnonzero(~self.broken)
        deepest = np.zeros(len(self.broken))
        self.sims.forward(ids=whole)
        for i in whole:
            contact = self.sims.get_data(int(i)).contact
            deepest[i] = -min(contact.dist.min(initial=0.0), 0.0)
        return deepest


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


def _hold_in(sims: mujoco_batch.Batch, mass: np.ndarray, *, up: bool) -> None:
    """Apply the fence's forces for the next control period; none once it is no longer up."""
    shape = mass.shape
    position = np.asarray(sims.qpos)[:, GRIPPER_DOF:].reshape(*shape, 7)[..., :2]
    velocity = np.asarray(sims.qvel)[:, GRIPPER_DOF:].reshape(*shape, 6)[..., :2]
    force = np.zeros((*shape, 6))
    if up:
        force[..., :2] = physics.fence_force(mass, position, velocity, xp=np)
    sims.qfrc_applied[:, GRIPPER_DOF:] = force.reshape(len(force), -1)


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
