"""MuJoCo C on all CPU cores, through `mujoco.batch`. The reference that the other engines are held against."""

from __future__ import annotations

import collections
import concurrent.futures
import copy
import dataclasses
import threading

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco import batch as mujoco_batch

from dipn_jax import physics, structs
from dipn_jax.engine import PhysicsConfig, Stopped
from dipn_jax.physics import hosted
from dipn_jax.structs import ABSENT, Array, Rollout, Scene, Trajectory
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import model
from dipn_jax.world.model import GRIPPER_DOF
from dipn_jax.world.scenes import parked

DEFAULTS = PhysicsConfig(falling_timestep=0.01 / 3, sleep=1e-3)
"""Sleeping halves the time and moves objects, after 5 cm of a push, by 0.01 mm (p50) and 0.4 mm (p90).

With the larger steps of a drop objects come to rest as with 2 ms; with 5 ms they would lie lower and farther apart
(`python -m benchmarks drops.cheaper --scale full` has p-values of both).
"""
ACCURATE_TIME = 0.5
"""Seconds at the end of a drop that have steps of `PhysicsConfig.timestep`."""
CAMERA_HEIGHT = 1.0
"""Metres above the table that rays are cast from."""
MODELS_KEPT = 256
"""Compiled models that an engine keeps, about 0.1 MB each."""


class NativeEngine:
    """An `Engine` on MuJoCo C. Results do not depend on the number of threads."""

    name = "native"
    batch = 64

    def __init__(self, config: PhysicsConfig = DEFAULTS, *, threads: int | None = None) -> None:
        self.config, self.substeps = config, physics.substeps(config)
        self.threads = threads or physics.cores()
        self.stopped, self._building = threading.Event(), threading.Lock()
        self._models: collections.OrderedDict[bytes, mujoco.MjModel] = collections.OrderedDict()

    def simulate(
        self,
        scenes: Scene,
        poses: Float[Array, "B N 7"],
        trajectories: Trajectory,
        samples: Float[Array, " S"],
        *,
        settle: bool = False,
        fence: float = 0.0,
    ) -> Rollout:
        """See `Engine.simulate`; takes arrays of any kind, returns NumPy arrays."""
        scenes, trajectories = jax.tree.map(np.asarray, (scenes, trajectories))
        poses = np.asarray(poses)
        packed, slots = hosted.pack(scenes)
        with self._building:
            models = self._compile(packed)
        dropped = settle and fence > 0 and self.config.falling_timestep
        falling = float(samples[-1]) - ACCURATE_TIME if dropped else 0.0
        targets = np.asarray(trajectories.target)
        still = (targets == targets[:, :1]).all((1, 2))
        sims = _Worlds(models, self, present=np.asarray(packed.shape) >= 0, still=still, falling=falling)
        start = np.where(
            packed.shape[..., None] >= 0, np.take_along_axis(poses, slots[..., None], 1), parked(packed.shape.shape[1])
        )
        sims.qpos[:, GRIPPER_DOF:] = start.reshape(len(models), -1)
        sims.qpos[:, :GRIPPER_DOF] = hosted.controls(trajectories, np.zeros(1))[0]
        return hosted.follow(sims, packed, slots, poses, trajectories, np.asarray(samples), settle=settle, fence=fence)

    def stop(self) -> None:
        """See `Engine.stop`."""
        self.stopped.set()

    def _compile(self, scenes: Scene) -> list[mujoco.MjModel]:
        """Return a model of each scene. Recent ones are kept, because a scene that has settled is then pushed."""

        def compiled(i: int) -> mujoco.MjModel:
            scene = jax.tree.map(lambda leaf: leaf[i], scenes)
            return mujoco.MjModel.from_xml_string(model.mjcf(scene, config=self.config, alike=True))

        physical = (scenes.shape, scenes.size, scenes.mass, scenes.friction)
        keys = [b"".join(leaf[i].tobytes() for leaf in physical) for i in range(len(scenes.shape))]
        missing = {key: i for i, key in enumerate(keys) if key not in self._models}
        with concurrent.futures.ThreadPoolExecutor(self.threads) as pool:
            self._models.update(zip(missing, pool.map(compiled, missing.values()), strict=True))
        models = [self._models[key] for key in keys]
        while len(self._models) > MODELS_KEPT:
            self._models.popitem(last=False)
        return models


class _Worlds:
    """See `hosted.Worlds`: views of a batch's fields."""

    def __init__(
        self,
        models: list[mujoco.MjModel],
        engine: NativeEngine,
        *,
        present: Bool[np.ndarray, "B N"],
        still: Bool[np.ndarray, " B"],
        falling: float,
    ) -> None:
        """Make worlds with objects where `present`, and with hands that never move where `still`.

        For the first `falling` seconds their steps are of `PhysicsConfig.falling_timestep`.
        """
        models = [copy.copy(one) for one in models] if falling > 0 else models  # their time step is going to change
        self._engine, self._models, self._present, self._still = engine, models, present, still
        self._tick, self._falling = 0, max(0, round(falling / physics.CONTROL_PERIOD))
        # persistent, for sleep
        self._batch = batch = mujoco_batch.Batch(models[0], nsim=len(models), nthread=engine.threads, persistent=True)
        batch.set_models(models)
        self.qpos, self.qvel, self.ctrl, self.qfrc_applied = map(batch.bind, ("qpos", "qvel", "ctrl", "qfrc_applied"))
        self._nearest = batch.bind("sensordata")  # [B, 1] metres: the only sensor of `model.mjcf`
        self._awake = batch.bind("tree_awake")  # [B, 1 + N]: the hand, then the objects

    @property
    def warning(self) -> np.ndarray:
        """See `hosted.Worlds`."""
        return np.asarray(self._batch.warning)

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        """See `hosted.Worlds`. Where the hand is still and everything sleeps, nothing is to be computed."""
        if self._engine.stopped.is_set():
            raise Stopped
        substeps = self._substeps()
        asleep = (self._awake[:, 1:] == 0) | ~self._present
        resting = self._still & asleep.all(-1)  # what a fence pushes does not sleep
        moving = np.flatnonzero(~resting) if self._tick > 1 else None  # before a first step nothing is known of sleep
        try:
            self._batch.step(moving, nstep=substeps)
        except mujoco_batch.SimulationError as error:
            cramped = np.array(["memory" in self._batch.error(int(i)) for i in error.ids], bool)
            return np.asarray(error.ids)[~cramped], np.asarray(error.ids)[cramped]
        return np.zeros(0, int), np.zeros(0, int)

    def _substeps(self) -> int:
        """Return the number of steps of the next control period, and give the models their time step."""
        config = self._engine.config
        if self._tick < self._falling:
            config = dataclasses.replace(config, timestep=config.falling_timestep)
        if self._falling and self._tick in (0, self._falling):
            for one in self._models:
                one.opt.timestep = config.timestep
        self._tick += 1
        return physics.substeps(config)

    def last_depths(self) -> np.ndarray:
        """See `hosted.Worlds`."""
        return -self._nearest[:, 0]

    def depths(self) -> np.ndarray:
        """See `hosted.Worlds`."""
        return contact_depths(self._models, np.array(self.qpos))


def contact_depths(models: list[mujoco.MjModel], qpos: np.ndarray) -> np.ndarray:
    """Return the deepest contact `[B]` in metres of `models`, all of one layout, at `qpos [B, Q]`; 0 if not finite.

    Sleeping objects have no contacts among themselves, so this looks at the state anew.
    """
    data, deepest = mujoco.MjData(models[0]), np.zeros(len(models))
    for i in np.flatnonzero(np.isfinite(qpos).all(-1)):
        data.qpos[:] = qpos[i]
        try:
            mujoco.mj_fwdPosition(models[i], data)
        except mujoco.FatalError:  # no room for its contacts: stepping has already noted this fault
            data = mujoco.MjData(models[0])
        deepest[i] = -min(data.contact.dist.min(initial=0.0), 0.0)
    return deepest


def raycast(scenes: Scene, poses: Float[Array, "B N 7"]) -> tuple[Float[np.ndarray, "B H W"], Int[np.ndarray, "B H W"]]:
    """Return what MuJoCo's ray caster sees from straight above: the reference of `dipn_jax.sight.render`.

    Args:
      scenes: B scenes.
      poses: metres and quaternions wxyz, workspace.

    Returns:
      Heights in metres and labels (object slots, ABSENT on the table) of the workspace, a pixel each.
    """
    scenes, poses = jax.tree.map(np.asarray, scenes), np.asarray(poses)
    models = [
        mujoco.MjModel.from_xml_string(model.mjcf(structs.take(scenes, i), config=PhysicsConfig(), alike=True))
        for i in range(len(poses))
    ]
    sims = mujoco_batch.Batch(models[0], nsim=len(models))
    sims.set_models(models)
    sims.qpos[:, 2] = 2 * CAMERA_HEIGHT  # the gripper is above the camera
    sims.qpos[:, GRIPPER_DOF:] = poses.reshape(len(poses), -1)
    pixels = WORKSPACE.pixels
    at = (np.arange(pixels) - (pixels - 1) / 2) * WORKSPACE.pixel
    x, y = np.meshgrid(at, at)
    start = np.stack([x.ravel(), y.ravel(), np.full(x.size, CAMERA_HEIGHT)], -1)
    distance, geom = sims.ray(start, np.array([0.0, 0.0, -1.0]))
    body = models[0].geom_bodyid[geom]
    label = np.where(body >= models[0].body("o0").id, body - models[0].body("o0").id, ABSENT)
    height = np.where(label == ABSENT, 0.0, CAMERA_HEIGHT - distance)
    return height.reshape(-1, pixels, pixels), label.reshape(-1, pixels, pixels)
