"""MuJoCo Warp: many scenes in one batch on a CUDA GPU, or slowly on the CPU. The third engine, from the same MJCF.

One model holds the meshes of all scenes (`warp_model`); `geom_dataid [B, ngeom]` says which of them each part of each
scene has, and other fields that depend on a scene have a leading world axis too. MJX's own `impl="warp"` drops that
axis of `geom_dataid`, so this calls the MuJoCo Warp inside MJX directly. A rollout stays on the device from its start
to its end (`warp_loop`): the host launches the same recorded control period again and again.

Set points, the fence and faults are the native engine's, and so is the elliptic cone. What differs: float32, and
cuboids are meshes of eight corners. Agreement with the native engine: docs/world.md.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dipn_jax import physics
from dipn_jax.engine import PhysicsConfig
from dipn_jax.errors import UserError
from dipn_jax.physics import CONTROL_PERIOD, hosted
from dipn_jax.physics.warp_worlds import JACOBIANS, Worlds
from dipn_jax.structs import Array, Rollout, Scene, Trajectory
from dipn_jax.world.model import GRIPPER_DOF
from dipn_jax.world.scenes import parked

DEFAULTS = PhysicsConfig()
"""Settings of the solver unless others are given."""
SCENES_AT_ONCE = 512
"""Maximum number of scenes simulated at once on a CPU."""
SCENES_AT_ONCE_ON_GPU = 2048
"""Maximum number of scenes simulated at once on a GPU. An H200 simulates 209 scene seconds a second with 512 and 353
with 2,048 (docs/benchmarks.md); more were not tried."""


class Room(NamedTuple):
    """Room in memory for each object of the fullest scene, and as much for the gripper.

    All scenes of a batch share their contacts and pairs; each has its own rows. Seen (`python -m benchmarks
    engines.warp_room`): at most 13 contacts, 2.5 pairs and 44 rows with one object, which a grasp presses on the
    table, and 8.8, 1.3 and 30 with three and more.
    """

    contacts: int = 16  # between any two geoms, the table and the gripper included
    pairs: int = 4  # of convex parts that touch, the table not counted
    rows: int = 64  # of constraints: three a contact


def _load() -> tuple[Any, Any]:
    """Return the modules `warp` and `mujoco_warp`.

    Raises:
      UserError: they are not installed, do not fit each other, or find no place for compiled kernels.
    """
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR  # else it writes to stdout
        warp.init()
        from mujoco.mjx.third_party import mujoco_warp
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise UserError(
            f"engine warp: {error}; want its packages (pip install 'dipn-jax[warp]') and a writable cache folder"
        ) from error
    return warp, mujoco_warp


class WarpEngine:
    """An `Engine` on MuJoCo Warp."""

    name = "warp"

    def __init__(
        self,
        config: PhysicsConfig = DEFAULTS,
        *,
        chunk: int | None = None,
        jacobian: str = "auto",
        room: tuple[int, int, int] = Room(),
        awake: int | None = None,
    ) -> None:
        """Make an engine; kernels are compiled when it is first used, and Warp caches them on disk.

        Args:
          config: solver settings; the control period must be a whole number of time steps.
          chunk: most scenes simulated at once; if not given, SCENES_AT_ONCE or SCENES_AT_ONCE_ON_GPU.
          jacobian: `dense`, `sparse`, or `auto`: sparse above MOST_DENSE_DOF degrees of freedom, as of five objects.
          room: see `Room`; what does not fit is left out, and a fault.
          awake: for tables at rest, not for drops: objects begin asleep, and at most this many of a scene can be awake
            at once; more are a fault. If not given, all begin awake. Wants `config.sleep`.

        Raises:
          UserError: Warp cannot be used, the time step does not divide the control period, or no such Jacobian, chunk,
            room or awake.
        """
        self.substeps = physics.substeps(config)
        if jacobian not in ("auto", *JACOBIANS):
            raise UserError(f"engine warp: jacobian {jacobian!r}: want auto, dense or sparse")
        if min(*room, 1 if chunk is None else chunk) < 1:
            raise UserError(f"engine warp: chunk {chunk}, room {tuple(room)}: want whole numbers from 1 on")
        if awake is not None and (awake < 1 or not config.sleep):
            raise UserError(
                f"engine warp: awake {awake}, sleep {config.sleep}: want objects from 1 on, and sleep above 0"
            )
        self.config, self.jacobian, self.room, self.awake = config, jacobian, Room(*room), awake
        self.stopped, self._running = threading.Event(), threading.Lock()
        self.warp, self.mujoco_warp = _load()
        self.device = self.warp.get_preferred_device()  # the first GPU, or else the CPU
        self.iterations = Iterations(0.0, 0.0, 0)
        self._worlds: Worlds | None = None  # the last ones, for the next that are as many
        self.chunk = self.batch = chunk or (SCENES_AT_ONCE_ON_GPU if self.device.is_cuda else SCENES_AT_ONCE)

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
        """See `Engine.simulate`; returns NumPy arrays."""
        args = jax.tree.map(np.asarray, (scenes, poses, trajectories))
        done = []
        with self._running, self.warp.ScopedDevice(self.device):
            for start in range(0, len(args[1]), self.chunk):
                some, where, paths = jax.tree.map(lambda leaf, at=start: leaf[at : at + self.chunk], args)
                done.append(self._simulate(some, where, paths, np.asarray(samples), settle, fence))
            self.iterations = Iterations.of(np.sum([taken for _, taken in done], 0))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *(rollout for rollout, _ in done))

    def stop(self) -> None:
        """See `Engine.stop`."""
        self.stopped.set()

    def _simulate(
        self, scenes: Scene, poses: np.ndarray, paths: Trajectory, instants: np.ndarray, settle: bool, fence: float
    ) -> tuple[Rollout, np.ndarray]:
        """Return the rollout of at most `chunk` scenes, and how often the solver took each number of iterations."""
        packed, slots = hosted.pack(scenes)
        present = np.asarray(packed.shape >= 0)
        start = np.where(present[..., None], np.take_along_axis(poses, slots[..., None], 1), parked(present.shape[1]))
        qpos = np.concatenate([hosted.controls(paths, np.zeros(1))[0], start.reshape(len(start), -1)], -1)
        frames = paths.time.shape[1]
        if self._worlds is None or not self._worlds.fit(packed, frames):
            self._worlds = None  # makes room for the next ones
            self._worlds = Worlds(packed, frames, self)
        states = self._worlds.run(packed, qpos, paths, instants, fence)
        watch = self._worlds.watched()
        target = hosted.controls(paths, np.array([np.round(instants[-1] / CONTROL_PERIOD) * CONTROL_PERIOD]))[0]
        fault = watch.codes(target, settle)
        found = np.stack([hosted.unpack(state[:, GRIPPER_DOF:], poses, slots, present) for state in states], 1)
        hand = np.stack([hosted.gripper(state) for state in states], 1)
        rollout = Rollout(found.astype(np.float32), hand.astype(np.float32), fault)
        return rollout, self._worlds.histogram.numpy()


class Iterations(NamedTuple):
    """Iterations of the solver, over all scenes and steps of a call of `simulate`."""

    mean: float
    p95: float
    most: int

    @classmethod
    def of(cls, times: np.ndarray) -> Iterations:
        """Return the statistics of a histogram: how often there were 0, 1, 2, ... iterations."""
        counts, total = np.arange(len(times)), max(int(times.sum()), 1)
        p95 = np.searchsorted(np.cumsum(times), 0.95 * total)
        return cls(float((counts * times).sum() / total), float(p95), int(counts[times > 0].max(initial=0)))
