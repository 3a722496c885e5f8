"""Batches of scenes on a device, under MuJoCo Warp, with the control loop beside them (`warp_loop`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from dipn_jax.engine import Stopped
from dipn_jax.errors import UserError
from dipn_jax.physics import CONTROL_PERIOD, faults, hosted, warp_loop, warp_model
from dipn_jax.structs import Scene, Trajectory
from dipn_jax.world import shapes
from dipn_jax.world.model import GRIPPER_DOF

if TYPE_CHECKING:
    from dipn_jax.physics.warp import WarpEngine

MOST_DENSE_DOF = 32
"""Degrees of freedom up to which a dense Jacobian is the default, as in MuJoCo Warp itself."""
KEY_FRAMES = 8
"""Key frames of a trajectory that there is room for at least, so that drops, pushes and grasps can follow another."""
SYNCHRONIZED = 16
"""Control periods after which the host waits for the device, so that it can be stopped."""
JACOBIANS = {
    "dense": mujoco.mjtJacobian.mjJAC_DENSE,
    "sparse": mujoco.mjtJacobian.mjJAC_SPARSE,
}
"""Forms of the constraints' Jacobian, by name."""


class Worlds:
    """A batch on a device. Its control period is recorded once, as a graph; on a GPU that is a CUDA graph."""

    def __init__(self, scenes: Scene, frames: int, engine: WarpEngine) -> None:
        """Make room for worlds like `scenes [B, N]` and paths of `frames` key frames, and put these scenes into it.

        Raises:
          UserError: MuJoCo Warp lacks something that the MJCF or the configuration asks for.
        """
        self.warp, self.mjw, self.engine = engine.warp, engine.mujoco_warp, engine
        self.kernels = warp_loop.kernels()
        batch, slots = scenes.shape.shape
        dense = GRIPPER_DOF + 6 * slots <= MOST_DENSE_DOF
        jacobian = engine.jacobian if engine.jacobian != "auto" else "dense" if dense else "sparse"
        self.spec = warp_model.compiled(slots, engine.config, JACOBIANS[jacobian])
        rows = dict.fromkeys(warp_model.SCENE_FIELDS, warp_model.row_count(batch))
        contacts, pairs, most = (each * (slots + 1) for each in engine.room)
        awake = None if engine.awake is None else GRIPPER_DOF + 6 * min(engine.awake, slots)
        try:
            self.model = self.mjw.put_model(self.spec, batch_sizes=rows)
            self.data = self.mjw.make_data(
                self.spec, batch, nconmax=max(contacts, pairs), nccdmax=pairs, njmax=most, nvmax=awake
            )
        except (NotImplementedError, ValueError) as error:
            raise UserError(f"engine warp: {error}") from error
        self.model.opt.warn_overflow = 0  # kept in `data.overflow` all the same
        zeros, f64 = self.warp.zeros, self.warp.float64
        self.tick, self.fence, self.since = zeros(1, int), zeros(1, f64), zeros(1, f64)
        self.mass, self.fastest = zeros((batch, slots), f64), zeros((batch, slots), f64)
        self.off, self.deepest = zeros((batch, 3), f64), zeros(batch, float)
        self.histogram = zeros(engine.config.iterations + 1, self.warp.int64)
        frames = max(frames, KEY_FRAMES)
        self.time, self.frame = zeros((batch, frames), float), zeros((batch, frames, 5), float)
        self.graph: Any = None
        self.load(scenes)

    def fit(self, scenes: Scene, frames: int) -> bool:
        """Return whether there is room for `scenes [B, N]` and paths of `frames` key frames."""
        return self.scenes.shape.shape == scenes.shape.shape and frames <= self.time.shape[1]

    def load(self, scenes: Scene) -> None:
        """Put other scenes of the same number and slots into the model."""
        self.scenes = scenes
        kind, size = warp_model.kinds(scenes), np.repeat(scenes.size, shapes.CONVEX_PARTS, 1)
        warp_model.put(self.warp, self.model, warp_model.mesh_fields(kind, size))
        warp_model.put(self.warp, self.model, warp_model.scene_fields(self.spec, scenes, kind, size))
        self.mass.assign(np.where(scenes.shape >= 0, scenes.mass, 0.0).astype(np.float64))

    def run(
        self, scenes: Scene, qpos: np.ndarray, paths: Trajectory, instants: np.ndarray, fence: float
    ) -> list[np.ndarray]:
        """Simulate from rest at `qpos [B, 6 + 7 N]`; return the positions at all `instants` (seconds).

        Raises:
          Stopped: the engine was stopped.
        """
        if scenes is not self.scenes:
            self.load(scenes)
        ahead = self.time.shape[1] - paths.time.shape[1]
        self.time.assign(np.pad(paths.time, ((0, 0), (0, ahead)), mode="edge"))
        self.frame.assign(np.pad(paths.target, ((0, 0), (0, ahead), (0, 0)), mode="edge"))
        self.fence.fill_(fence)
        self.since.fill_(max(fence, faults.GRACE_TIME))
        if self.graph is None:
            self.graph = self._record()
        self._reset(qpos)
        ticks = np.round(instants / CONTROL_PERIOD).astype(int)
        stored: dict[int, Any] = {}
        for tick in range(int(ticks[-1]) + 1):
            if tick in ticks:
                stored[tick] = self.warp.clone(self.data.qpos)
            if tick < ticks[-1]:
                if self.engine.stopped.is_set():
                    raise Stopped
                self._period()
            if tick % SYNCHRONIZED == 0:
                self.warp.synchronize_device()
        return [stored[tick].numpy() for tick in ticks]

    def _reset(self, qpos: np.ndarray) -> None:
        """Begin again, at rest at `qpos`."""
        self.mjw.reset_data(self.model, self.data)
        self.data.qpos.assign(qpos.astype(np.float32))
        if self.engine.awake is not None:
            self._fall_asleep()
        for noted in (self.tick, self.fastest, self.off, self.deepest, self.histogram):
            noted.zero_()

    def _fall_asleep(self) -> None:
        """Put every object to sleep, each by itself."""
        objects = np.arange(self.spec.ntree - self.mass.shape[1], self.spec.ntree)
        asleep = self.data.tree_asleep.numpy()  # the next of those that fell asleep together; negative: awake
        asleep[:, objects] = objects
        self.data.tree_asleep.assign(asleep)
        self.data.tree_awake.assign((asleep < 0).astype(np.int32))

    def _record(self) -> Any:
        """Record a control period as a graph to replay; False on a GPU that cannot record one."""
        device = self.warp.get_device()
        if device.is_cuda:
            self.model.opt.graph_conditional = self.warp.is_conditional_graph_supported()
            if not self.warp.is_mempool_enabled(device):
                return False
        self._launch(substeps=1)  # compiles and loads the kernels, which cannot be recorded
        with self.warp.ScopedCapture() as capture:
            self._launch(substeps=self.engine.substeps)
        return capture.graph

    def _period(self) -> None:
        """Simulate one control period."""
        if self.graph:
            self.warp.capture_launch(self.graph)
        else:
            self._launch(substeps=self.engine.substeps)

    def _launch(self, *, substeps: int) -> None:
        """Launch the kernels of a control period."""
        launch, do, data, paths = self.warp.launch, self.kernels, self.data, (self.tick, self.time, self.frame)
        worlds, slots = self.mass.shape
        launch(do.steer, worlds, [*paths, data.ctrl])
        fenced = [self.tick, self.fence, self.mass, data.qpos, data.qvel, data.qfrc_applied]
        launch(do.apply_fence, (worlds, slots, 2), fenced)
        for _ in range(substeps):
            self.mjw.step(self.model, data)
            launch(do.count, worlds, [data.solver_niter, self.histogram])
        launch(do.watch, worlds, [*paths, data.qpos, data.qvel, self.fastest, self.off])
        contact = [data.nacon, data.contact.worldid, data.contact.dist, self.deepest]
        launch(do.note_depth, data.naconmax, [self.tick, self.since, *contact])
        launch(do.advance, 1, [self.tick])

    def watched(self) -> hosted.Watch:
        """Return what was noted of the rollout that has ended."""
        self.qpos, self.qvel = self.data.qpos.numpy().astype(float), self.data.qvel.numpy().astype(float)
        watch = hosted.Watch(self.scenes, self)
        watch.fastest, watch.off, watch.deepest = self.fastest.numpy(), self.off.numpy(), self.deepest.numpy()
        return watch

    def last_depths(self) -> np.ndarray:
        """See `hosted.State`."""
        return self.depths()

    def depths(self) -> np.ndarray:
        """See `hosted.State`; these are the depths of the last step, but where objects sleep."""
        if self.engine.config.sleep:  # whose contacts among themselves are not looked for
            self.mjw.reset_data(self.model, self.data)
            self.data.qpos.assign(self.qpos.astype(np.float32))
            self.mjw.fwd_position(self.model, self.data)
        deepest = np.zeros(len(self.qpos))
        count = min(int(self.data.nacon.numpy()[0]), self.data.naconmax)
        contact = self.data.contact
        np.maximum.at(deepest, contact.worldid.numpy()[:count], -contact.dist.numpy()[:count])
        return deepest

    @property
    def warning(self) -> np.ndarray:
        """Warnings as in MuJoCo C `[B, W, 2]` (last info, count); lack of room for contacts marks the whole batch."""
        kind, seen = self.mjw.OverflowType, self.data.overflow.numpy()
        contacts, rows = kind.BROADPHASE | kind.NARROWPHASE | kind.CCD, kind.NEFC | kind.NJMAX_NNZ | kind.NVMAX
        out = np.zeros((len(seen), int(mujoco.mjtWarning.mjNWARNING), 2), int)
        out[:, int(mujoco.mjtWarning.mjWARN_CONTACTFULL), 1] = (seen & int(contacts)) != 0
        out[:, int(mujoco.mjtWarning.mjWARN_CNSTRFULL), 1] = (seen & int(rows)) != 0
        return out
