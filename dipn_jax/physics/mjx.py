"""MuJoCo MJX: whole batches in one XLA program, on a GPU, a TPU or a CPU.

Shapes, sizes, masses, friction, poses and trajectories are traced; only the number of scenes and of object
slots is compiled in. So all primitives and all scenes of one layout share one program (see `prisms` for how).

Friction cones are elliptic, as in the native engine, with a solver of ours (`cone`): MJX's own diverges in float32.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import mjx
from mujoco.mjx._src import collision_driver
from mujoco.mjx._src.types import GeomType

from dipn_jax import physics
from dipn_jax.engine import PhysicsConfig, Stopped
from dipn_jax.errors import UserError
from dipn_jax.physics import cone, faults, kept, prisms, recording
from dipn_jax.physics.recording import Record, State
from dipn_jax.structs import Array, Rollout, Scene, Trajectory
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import model, shapes
from dipn_jax.world.model import GRIPPER_DOF
from dipn_jax.world.scenes import parked

DEFAULTS = PhysicsConfig(
    timestep=0.0025,  # as near to the native engine's 0.002 as its own 0.001 is; at 0.005 1 grasp in 10 ends otherwise
    geom_pairs=(32, 4),  # measured: at most 26 overlapping bounding spheres (10 objects, a push)
    contact_points=(80, 8),  # measured: at most 54 contacts with 7 objects, 75 with 10
)
KEY_FRAMES = 8
"""Trajectories are padded to as many key frames, so that all primitives share one program."""
SAMPLES = 12
"""Sampled instants are padded likewise."""


class MjxEngine:
    """See `Engine`."""

    name = "mjx"

    def __init__(
        self, config: PhysicsConfig = DEFAULTS, *, chunk: int | None = None, devices: Sequence[jax.Device] | None = None
    ) -> None:
        """An engine that compiles when it first meets a layout.

        Args:
          config: solver settings; the control period must be a whole number of time steps.
          chunk: most scenes simulated at once, whatever is asked for: it bounds the memory. A power of two; if not
            given 16 on a CPU, where more cost 1.4 times as much a scene (all wait for the slowest), else 1024.
          devices: share every chunk; all local ones if not given. A power of two of them are used.

        Raises:
          UserError: the control period is not a whole number of time steps, or `chunk` is no power of two.
        """
        self.substeps = physics.substeps(config)
        prisms.register()
        cone.register()
        self.config = config
        local = list(devices or jax.local_devices())
        self.devices = local[: 1 << (len(local).bit_length() - 1)]
        if chunk and chunk & (chunk - 1):
            raise UserError(f"mjx: chunk {chunk}; want a power of two")
        on_cpu = self.devices[0].platform == "cpu"
        self.chunk, self.batch = chunk or (16 if on_cpu else 1024), 64 if on_cpu else 1024
        # by number of scenes, slots, instants and key frames
        self.programs: dict[tuple[int, ...], Callable[..., Rollout]] = {}
        self._stopped, self._lock = threading.Event(), threading.Lock()

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
        """See `Engine.simulate`; numpy arrays out."""
        ticks = np.round(np.asarray(samples) / physics.CONTROL_PERIOD).astype(np.int32)
        padded = np.append(ticks, np.full(max(SAMPLES - len(ticks), 0), -1, np.int32))
        args = jax.tree.map(np.asarray, (scenes, poses, _pad(trajectories)))
        batch, slots = args[0].shape.shape
        # powers of two, so that batches of many sizes share few programs
        size = max(min(1 << (batch - 1).bit_length(), self.chunk), len(self.devices))
        done: list[Rollout] = []
        # MJX relies on rank promotion; contacts need whole float32 products, which accelerators else shorten
        with self._lock, jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
            for start in range(0, batch, size):
                rows = np.minimum(np.arange(start, start + size), batch - 1)
                part = jax.tree.map(lambda leaf, rows=rows: leaf[rows], args)
                if self._stopped.is_set():
                    raise Stopped
                whole = *part, _room(size, len(padded), slots), padded, np.bool_(settle), np.float32(fence)
                fresh = self._program(size, slots, whole)(*whole)
                done = [*done[:-1], *jax.device_get(done[-1:]), fresh]  # fetched while the next one runs
        out = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves])[:batch], *done)
        return Rollout(out.poses[:, : len(ticks)], out.gripper[:, : len(ticks)], out.fault)

    def _program(self, size: int, slots: int, arguments: tuple[Any, ...]) -> Callable[..., Rollout]:
        """The compiled function for `size` scenes of `slots` objects: each device runs its share by itself."""
        key = size, slots, len(arguments[4]), arguments[2].time.shape[1]
        if key not in self.programs:
            made = _Program(self.config, slots, self.substeps)
            alone = len(self.devices) == 1 and self.devices[0].platform == jax.default_backend()
            self.programs[key] = self._kept(made, arguments) if alone else self._shared(made)
        return self.programs[key]

    def _shared(self, made: _Program) -> Callable[..., Rollout]:
        """On all devices."""
        mesh = jax.sharding.Mesh(np.array(self.devices), ("batch",))
        split, whole = jax.sharding.PartitionSpec("batch"), jax.sharding.PartitionSpec()
        run = jax.shard_map(
            made.run,
            mesh=mesh,
            in_specs=(split, split, split, split, whole, whole, whole),
            out_specs=split,
            check_vma=False,  # MJX starts its loops from constants, which that check refuses
        )
        return jax.jit(run, donate_argnums=3)

    def _kept(self, made: _Program, arguments: tuple[Any, ...]) -> Callable[..., Rollout]:
        """On the only device, traced once for all processes."""
        tree = jax.tree.structure(arguments)
        first = len(jax.tree.leaves(arguments[:3]))  # of the record's memory

        def flat(*leaves: jax.Array) -> tuple[Array, ...]:
            out = made.run(*jax.tree.unflatten(tree, leaves))
            return out.poses, out.gripper, out.fault

        donate = range(first, first + len(arguments[3]))
        call = kept.program(flat, jax.tree.leaves(arguments), what=f"mjx {self.config} highest", donate=donate)

        def run(*args: Any) -> Rollout:
            with jax.default_device(self.devices[0]):
                return Rollout(*call(*jax.tree.leaves(args)))

        return run

    def stop(self) -> None:
        """See `Engine.stop`: at the end of the chunk at hand."""
        self._stopped.set()


def _room(batch: int, samples: int, slots: int) -> tuple[Array, Array]:
    """Memory for poses and gripper of a record, which the result takes over."""
    return np.zeros((batch, samples, slots, 7), np.float32), np.zeros((batch, samples, 5), np.float32)


def _pad(trajectories: Trajectory) -> Trajectory:
    """As many as `KEY_FRAMES` key frames: the last one repeats, a second apart."""
    time, target = np.asarray(trajectories.time, np.float32), np.asarray(trajectories.target, np.float32)
    more = max(KEY_FRAMES - time.shape[1], 0)
    later = time[:, -1:] + np.arange(1, more + 1, dtype=np.float32)
    return Trajectory(np.concatenate([time, later], 1), np.concatenate([target, *[target[:, -1:]] * more], 1))


def _adapt(spec: mujoco.MjModel) -> None:
    """What the MJCF says and MJX has no use for."""
    # MJX keeps `contact_points` rows for each condim: with the pads at 4 the solver has 2.5 times the rows and a step
    # takes 1.6 times as long, for a torsional friction that the several contacts of a pad have without it
    spec.geom_condim[spec.geom_condim == 4] = 3


class _Program:
    """The traced function for one number of slots, with the placeholder model it fills."""

    def __init__(self, config: PhysicsConfig, slots: int, substeps: int) -> None:
        self.slots, self.substeps = slots, substeps
        self.pairs, self.contacts = config.caps(slots)
        full = np.full(slots, 0.1, np.float32)
        scene = Scene(np.zeros(slots, np.int32), np.full((slots, 3), 0.05), np.zeros((slots, 3)), full, full)
        spec = mujoco.MjModel.from_xml_string(model.mjcf(scene, config=config, generic=True))
        _adapt(spec)
        self.base = mjx.put_model(spec, impl="jax")
        self.data = mjx.make_data(self.base)
        self.first_geom, self.first_body = spec.ngeom - slots * shapes.PARTS, spec.nbody - slots
        groups = collision_driver._geom_groups(self.base)
        self.culled = [
            np.array(pairs)[:, :2]
            for key, pairs in groups.items()
            if key.types[0] != GeomType.PLANE and -1 < self.pairs < len(pairs)
        ]

    def run(
        self,
        scenes: Scene,
        poses: jax.Array,
        trajectories: Trajectory,
        room: tuple[jax.Array, jax.Array],
        ticks: jax.Array,
        settle: jax.Array,
        fence: jax.Array,
    ) -> Rollout:
        """`MjxEngine.simulate` with padded key frames `[B, 8]`, room for a record, control ticks `[12]` (-1: none)."""
        present = scenes.shape >= 0
        fields = jax.vmap(self._fields)(scenes)
        start = jnp.where(present[..., None], poses, parked(self.slots))
        mass = jnp.where(present, scenes.mass, 0.0)
        target = functools.partial(recording.control, trajectories)
        state = jax.vmap(self._initial)(start, target(0.0))
        none = jnp.zeros(len(poses))
        record = Record(*room, top=none, stray=none, broken=none > 0, deepest=none)

        # in whole ticks: in float32 ten periods are less than a tenth of a second
        fenced, grace = jnp.round(fence / physics.CONTROL_PERIOD), round(faults.GRACE / physics.CONTROL_PERIOD)

        def body(tick: jax.Array, carry: tuple[State, Record]) -> tuple[State, Record]:
            state, record = carry
            record = recording.store(record, state, ticks == tick)
            ctrl = target(tick * physics.CONTROL_PERIOD + GRIPPER.lag)
            force = jnp.where(tick < fenced, recording.hold_in(mass, state), 0.0)
            state = jax.vmap(self._tick)(fields, state, ctrl, force)
            due = target((tick + 1) * physics.CONTROL_PERIOD)
            return state, recording.watch(record, state, scenes, due, deep=tick >= jnp.maximum(fenced, grace))

        last = ticks.max()
        state, record = jax.lax.fori_loop(0, last, body, (state, record))
        record = recording.store(record, state, ticks == last)
        end = target(last * physics.CONTROL_PERIOD)
        fault = faults.codes(
            scenes,
            state.qpos[:, GRIPPER_DOF:].reshape(*present.shape, 7),
            recording.velocity(state, scenes),
            state.qpos[:, :3],
            end[:, :3],
            top=record.top,
            stray=record.stray,
            broken=record.broken,
            full=state.full,
            depth=state.depth,
            deepest=record.deepest,
            settle=settle,
        )
        kept = jnp.where(present[:, None, :, None], record.poses, poses[:, None])
        return Rollout(kept, record.gripper, fault)

    def _initial(self, poses: jax.Array, ctrl: jax.Array) -> State:
        rest = jnp.zeros(self.base.nv, jnp.float32)
        qpos = jnp.concatenate([ctrl, poses.reshape(-1)]).astype(jnp.float32)
        return State(qpos, rest, rest, jnp.zeros((), bool), jnp.zeros((), jnp.float32))

    def _fields(self, scene: Scene) -> dict[str, Any]:
        """The leaves of the model that depend on one scene."""
        base, present = self.base, scene.shape >= 0
        parts = jax.vmap(prisms.parts)(scene.shape, scene.size)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), parts)
        mass = jnp.where(present, scene.mass, 0.1)
        inertia = jnp.where(present[:, None], jax.vmap(shapes.inertia)(scene.shape, scene.size, mass), 1e-4)
        mu = jnp.where(present, scene.friction, 1.0).repeat(shapes.PARTS)
        g, b = slice(self.first_geom, None), slice(self.first_body, None)
        still = jnp.array([1.0, 0.0, 0.0, 0.0])
        light = jnp.stack([1 / mass, (1 / inertia).mean(-1)], -1)  # inverse weights: translation, rotation
        total = mass.sum() + base.body_mass[: self.first_body].sum()
        return {
            "geom_pos": base.geom_pos.at[g].set(flat.center),
            "geom_quat": base.geom_quat.at[g].set(still),
            "geom_size": base.geom_size.at[g].set(flat.alive[:, None]),
            "geom_rbound": base.geom_rbound.at[g].set(flat.radius),
            "geom_friction": base.geom_friction.at[g, 0].set(mu * model.OBJECT_FRICTION_RATIO),
            "pair_friction": base.pair_friction.at[:, :2].set(mu[:, None]),
            "body_mass": base.body_mass.at[b].set(mass),
            "body_subtreemass": base.body_subtreemass.at[b].set(mass).at[0].set(total),
            "body_inertia": base.body_inertia.at[b].set(inertia),
            "body_invweight0": base.body_invweight0.at[b].set(light),
            "dof_invweight0": base.dof_invweight0.at[GRIPPER_DOF:].set(light.repeat(3, -1).reshape(-1)),
            "_impl.mesh_convex": (jax.tree.map(self._per_geom, flat.mesh),),
        }

    def _per_geom(self, leaf: jax.Array) -> jax.Array:
        """Rows for the geoms that are no part of an object in front of `leaf [3 N, ...]`."""
        return jnp.concatenate([jnp.zeros((self.first_geom, *leaf.shape[1:]), leaf.dtype), leaf])

    def _tick(self, fields: dict[str, Any], state: State, ctrl: jax.Array, force: jax.Array) -> State:
        """One control period of one scene."""
        m = self.base.tree_replace(fields)

        def substep(state: State, _: None) -> tuple[State, None]:
            d = self.data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)
            d = mjx.step(m, d.replace(ctrl=ctrl, qfrc_applied=force))
            full = state.full | self._saturated(m, d)
            depth = jnp.maximum(0.0, -d._impl.contact.dist.min())
            return jax.tree.map(_strong, State(d.qpos, d.qvel, d.qacc_warmstart, full, depth), state), None

        return jax.lax.scan(substep, state, None, length=self.substeps)[0]

    def _saturated(self, m: Any, d: Any) -> jax.Array:
        """Whether MJX may have left out a touching pair or a contact in this step; it says nothing itself."""
        contact, limit = d._impl.contact, self.contacts
        full = jnp.zeros((), bool)
        for dim in np.unique(contact.dim):
            rows = contact.dim == dim
            if rows.sum() == limit:
                full |= (contact.dist[rows] < 0).all()
            full |= (contact.dist[rows] == prisms.LEFT_OUT).any()
        for first, second in (pairs.T for pairs in self.culled):
            apart = jnp.linalg.norm(d.geom_xpos[first] - d.geom_xpos[second], axis=-1)
            near = apart < m.geom_rbound[first] + m.geom_rbound[second]
            full |= near.sum() > self.pairs
        return full


def _strong(new: jax.Array, old: jax.Array) -> jax.Array:
    """`new` with the type of `old`: MJX returns weak types, which a loop does not take."""
    return jnp.asarray(new).astype(old.dtype)
