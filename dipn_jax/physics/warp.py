"""MuJoCo Warp: many scenes in one batch on a CUDA GPU, or slowly on the CPU. The third engine, from the same MJCF.

One compiled model holds the meshes of all scenes; `geom_dataid [B, ngeom]` says which of them each part of each
scene has, and other fields that depend on a scene (`_fields`) have a leading world axis too. MJX's own
`impl="warp"` drops that axis of `geom_dataid`, so this calls the MuJoCo Warp inside MJX directly.

Set points, the fence and faults are the native engine's, and so is the elliptic cone. What differs: float32, and
cuboids are meshes of eight corners. Agreement with the native engine: docs/world.md.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from dipn_jax import physics
from dipn_jax.engine import PhysicsConfig, Stopped
from dipn_jax.errors import UserError
from dipn_jax.physics import hosted
from dipn_jax.structs import Array, Rollout, Scene, Trajectory
from dipn_jax.world import model, shapes
from dipn_jax.world.model import GRIPPER_DOF
from dipn_jax.world.scenes import parked

DEFAULTS = PhysicsConfig()
CHUNK, CHUNK_ON_GPU = 512, 2048
"""Most scenes simulated at once, on a CPU and on a GPU. An H200 made 209 scene seconds a second of 512 and 353 of 2,048
(docs/benchmarks.md); more were not tried there."""
MOST_DENSE_DOF = 32
"""Degrees of freedom up to which a dense Jacobian is the default, as in MuJoCo Warp itself."""
JACOBIANS = {
    "dense": mujoco.mjtJacobian.mjJAC_DENSE,
    "sparse": mujoco.mjtJacobian.mjJAC_SPARSE,
}
"""Forms of the constraints' Jacobian, by name."""


class Room(NamedTuple):
    """How much there is room for, times the objects of the fullest scene and the gripper.

    All scenes of a batch share their contacts and pairs; each has its own rows. Seen (`python -m benchmarks
    engines.warp_room`): at most 13 contacts, 2.5 pairs and 44 rows with one object, which a grasp presses on the
    table, and 8.8, 1.3 and 30 with three and more.
    """

    contacts: int = 16
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
    ) -> None:
        """Make an engine; kernels are compiled when it is first used, and Warp caches them on disk.

        Args:
          config: solver settings; the control period must be a whole number of time steps.
          chunk: most scenes simulated at once; if not given, CHUNK or CHUNK_ON_GPU.
          jacobian: `dense`, `sparse`, or `auto`: sparse above MOST_DENSE_DOF degrees of freedom, as of five objects.
          room: see `Room`; what does not fit is left out, and a fault.

        Raises:
          UserError: Warp cannot be used, the time step does not divide the control period, or no such Jacobian, chunk
            or room.
        """
        self.substeps = physics.substeps(config)
        if jacobian not in ("auto", *JACOBIANS):
            raise UserError(f"engine warp: jacobian {jacobian!r}: want auto, dense or sparse")
        if min(*room, 1 if chunk is None else chunk) < 1:
            raise UserError(f"engine warp: chunk {chunk}, room {tuple(room)}: want whole numbers from 1 on")
        self.config, self.jacobian, self.room = config, jacobian, Room(*room)
        self.stopped, self._running = threading.Event(), threading.Lock()
        self.warp, self.mujoco_warp = _load()
        self.device = self.warp.get_preferred_device()  # the first GPU, or else the CPU
        self.chunk = self.batch = chunk or (CHUNK_ON_GPU if self.device.is_cuda else CHUNK)

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
        for start in range(0, len(args[1]), self.chunk):
            some, where, paths = jax.tree.map(lambda leaf, at=start: leaf[at : at + self.chunk], args)
            with self._running, self.warp.ScopedDevice(self.device):
                done.append(self._simulate(some, where, paths, np.asarray(samples), settle, fence))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *done)

    def stop(self) -> None:
        """See `Engine.stop`."""
        self.stopped.set()

    def _simulate(
        self, scenes: Scene, poses: np.ndarray, paths: Trajectory, instants: np.ndarray, settle: bool, fence: float
    ) -> Rollout:
        packed, slots = hosted.pack(scenes, poses)
        present = packed.shape >= 0
        start = np.where(present[..., None], np.take_along_axis(poses, slots[..., None], 1), parked(present.shape[1]))
        qpos = np.concatenate([hosted.controls(paths, np.zeros(1))[0], start.reshape(len(start), -1)], -1)
        sims = Worlds(packed, qpos, self)
        return hosted.follow(sims, packed, slots, poses, paths, instants, settle=settle, fence=fence)


class Worlds:
    """See `hosted.Worlds`: a batch on a device, with copies of its state on the host in between.

    The steps of a control period are recorded once, as a graph; on a GPU that is a CUDA graph.
    """

    def __init__(self, scenes: Scene, qpos: np.ndarray, engine: WarpEngine) -> None:
        """Make worlds at rest at `qpos [B, 6 + 7 N]`.

        Raises:
          UserError: MuJoCo Warp lacks something that the MJCF or the configuration asks for.
        """
        self.warp, self.mjw = engine.warp, engine.mujoco_warp
        self.engine = engine
        batch, slots = scenes.shape.shape
        spec, mesh = _compile(scenes, engine)
        fields = _fields(spec, scenes, mesh)
        try:
            self.model = self.mjw.put_model(spec, batch_sizes={name: len(rows) for name, rows in fields.items()})
        except (NotImplementedError, ValueError) as error:
            raise UserError(f"engine warp: {error}") from error
        for name, rows in fields.items():
            here = getattr(self.model, name)
            here.assign(rows.reshape(here.numpy().shape))
        self.model.opt.warn_overflow = 0  # kept in `data.overflow` all the same
        contacts, pairs, most = (each * (slots + 1) for each in engine.room)
        self.data = self.mjw.make_data(spec, batch, nconmax=max(contacts, pairs), nccdmax=pairs, njmax=most)
        self.qpos, self.qvel = qpos, np.zeros((batch, spec.nv))
        self.ctrl, self.qfrc_applied = np.zeros((batch, spec.nu)), np.zeros((batch, spec.nv))
        self.graph = self._capture(engine.substeps)
        self.data.qpos.assign(qpos.astype(np.float32))

    def _capture(self, substeps: int) -> Any:
        """Record the steps of a control period as a graph to replay; None on a GPU that cannot record one."""
        device = self.warp.get_device()
        if device.is_cuda:
            self.model.opt.graph_conditional = self.warp.is_conditional_graph_supported()
            if not self.warp.is_mempool_enabled(device):
                return None
        self.data.qpos.assign(self.qpos.astype(np.float32))
        self.mjw.step(self.model, self.data)  # compiles and loads the kernels, which cannot be recorded
        with self.warp.ScopedCapture() as capture:
            for _ in range(substeps):
                self.mjw.step(self.model, self.data)
        self.mjw.reset_data(self.model, self.data)
        return capture.graph

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        """See `hosted.Worlds`; no world is given up."""
        if self.engine.stopped.is_set():
            raise Stopped
        self.data.ctrl.assign(self.ctrl.astype(np.float32))
        self.data.qfrc_applied.assign(self.qfrc_applied.astype(np.float32))
        if self.graph is not None:
            self.warp.capture_launch(self.graph)
        else:
            for _ in range(self.engine.substeps):
                self.mjw.step(self.model, self.data)
        self.qpos, self.qvel = self.data.qpos.numpy().astype(float), self.data.qvel.numpy().astype(float)
        return np.zeros(0, int), np.zeros(0, int)

    def depths(self) -> np.ndarray:
        """See `hosted.Worlds`; these are the depths of the last step, too."""
        return self.last_depths()

    def last_depths(self) -> np.ndarray:
        """See `hosted.Worlds`; nothing sleeps."""
        deepest = np.zeros(len(self.qpos))
        count = min(int(self.data.nacon.numpy()[0]), self.data.naconmax)
        contact = self.data.contact
        np.maximum.at(deepest, contact.worldid.numpy()[:count], -contact.dist.numpy()[:count])
        return deepest

    @property
    def warning(self) -> np.ndarray:
        """Warnings as in MuJoCo C `[B, W, 2]` (last info, count); lack of room for contacts marks the whole batch."""
        kind, seen = self.mjw.OverflowType, self.data.overflow.numpy()
        contacts, rows = kind.BROADPHASE | kind.NARROWPHASE | kind.CCD, kind.NEFC | kind.NJMAX_NNZ
        out = np.zeros((len(seen), int(mujoco.mjtWarning.mjNWARNING), 2), int)
        out[:, int(mujoco.mjtWarning.mjWARN_CONTACTFULL), 1] = (seen & int(contacts)) != 0
        out[:, int(mujoco.mjtWarning.mjWARN_CNSTRFULL), 1] = (seen & int(rows)) != 0
        return out


def _compile(scenes: Scene, engine: WarpEngine) -> tuple[mujoco.MjModel, np.ndarray]:
    """Return the model of all `scenes [B, N]`, and the mesh of each part `[B, N, P]`; -1 where there is none."""
    text = model.mjcf(jax.tree.map(lambda leaf: leaf[0], scenes), config=engine.config, generic=True)
    spec = mujoco.MjSpec.from_string(text)
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp has no reset to disable
    dense = GRIPPER_DOF + 6 * scenes.shape.shape[1] <= MOST_DENSE_DOF
    jacobian = engine.jacobian if engine.jacobian != "auto" else "dense" if dense else "sparse"
    spec.option.jacobian = JACOBIANS[jacobian]
    names, made = np.full((*scenes.shape.shape, shapes.PARTS), "", object), set()
    for b, slot in np.argwhere(scenes.shape >= 0):
        shape, size = int(scenes.shape[b, slot]), scenes.size[b, slot].astype(float)
        for part in np.flatnonzero(shapes.CORNERS_USED[shape]):
            names[b, slot, part] = name = f"{shape} {part} {size.tobytes().hex()}"
            if name not in made:
                corners = int(shapes.CORNERS_USED[shape, part])
                rings = (shapes.UNIT_VERTICES[shape, part] * size).reshape(2, shapes.CORNERS, 3)
                spec.add_mesh(name=name, uservert=rings[:, :corners].ravel())
                made.add(name)
    built = spec.compile()
    index = {name: built.mesh(name).id for name in made} | {"": -1}
    return built, np.vectorize(index.__getitem__, otypes=[np.int32])(names)


def _fields(spec: mujoco.MjModel, scenes: Scene, mesh: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of the model that have a row a scene, for `scenes [B, N]` and their parts' `mesh [B, N, P]`.

    Rows are filled up to a power of two, at least two: kernels are compiled for their number, and only with more
    than one is a geom without a mesh left out.
    """
    batch, slots = scenes.shape.shape
    rows = np.minimum(np.arange(max(2, 1 << (batch - 1).bit_length())), batch - 1)
    scenes, mesh = jax.tree.map(lambda leaf: leaf[rows], scenes), mesh[rows].reshape(len(rows), -1)
    present = scenes.shape >= 0
    mass, mu = np.where(present, scenes.mass, 0.1), np.where(present, scenes.friction, 1.0).repeat(shapes.PARTS, -1)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), scenes)
    inertia = model.inertias(flat).reshape(*present.shape, 3)
    light = np.stack([1 / mass, (1 / inertia).mean(-1)], -1)  # inverse weights: translation, rotation
    geoms, bodies = slice(spec.ngeom - slots * shapes.PARTS, None), slice(spec.nbody - slots, None)
    changes: dict[str, tuple[tuple[slice | int, ...], np.ndarray]] = {
        **{name: ((geoms,), table[mesh]) for name, table in _outlines(spec).items()},
        "geom_dataid": ((geoms,), mesh),
        "geom_friction": ((geoms, 0), mu * model.OBJECT_FRICTION_RATIO),
        "pair_friction": ((slice(None), slice(0, 2)), mu[..., None]),
        "body_mass": ((bodies,), mass),
        "body_subtreemass": ((bodies,), mass),
        "body_inertia": ((bodies,), inertia),
        "body_invweight0": ((bodies,), light),
        "dof_invweight0": ((slice(GRIPPER_DOF, None),), light.repeat(3, -1).reshape(len(rows), -1)),
    }
    out = {name: np.repeat(np.asarray(getattr(spec, name))[None], len(rows), 0) for name in changes}
    for name, (at, value) in changes.items():
        out[name][(slice(None), *at)] = value
    out["body_subtreemass"][:, 0] = out["body_mass"].sum(-1)
    return out


def _outlines(spec: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the fields of a geom that follow from its mesh, for each mesh: frame in the object's, and bounds."""
    ends = spec.mesh_vertadr + spec.mesh_vertnum
    corners = [spec.mesh_vert[start:end] for start, end in zip(spec.mesh_vertadr, ends, strict=True)]
    low, high = (np.stack([reach(c, axis=0) for c in corners]) for reach in (np.min, np.max))
    return {
        "geom_pos": spec.mesh_pos,
        "geom_quat": spec.mesh_quat,
        "geom_size": (high - low) / 2,
        "geom_aabb": np.concatenate([(high + low) / 2, (high - low) / 2], -1),
        "geom_rbound": np.stack([np.linalg.norm(c, axis=-1).max() for c in corners]),
    }
