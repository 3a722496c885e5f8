"""MuJoCo MJX: whole batches in one XLA program, on a GPU, a TPU or a CPU.

Shapes, sizes, masses, friction, poses and trajectories are traced; only the number of scenes and of object
slots is compiled in. So all primitives and all scenes of one layout share one program (see `prisms` for how).

What differs from the native engine, by measurement: MJX's elliptic friction cone diverges in float32 with the
Newton solver, so `DEFAULTS` has the pyramidal one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver
from mujoco.mjx._src.types import GeomType

from dipn_jax import model, physics, shapes
from dipn_jax.model import GRIPPER_DOF, PhysicsConfig
from dipn_jax.physics import prisms
from dipn_jax.scenes import parked
from dipn_jax.structs import Array, Fault, Pytree, Rollout, Scene, Trajectory
from dipn_jax.workspace import GRIPPER, WORKSPACE

DEFAULTS = PhysicsConfig(
    timestep=0.01 / 3,  # at 0.005 a squeezed object trembles, and a thin hold of 5 mm slips out
    iterations=50,  # with 20 and a tolerance of 1e-6, 1 drop in 16 (7 objects) popped and ended in NaN; none with these
    cone="pyramidal",
    geom_pairs=32,  # measured: at most 26 overlapping bounding spheres (10 objects, a push)
    contact_points=80,  # measured: at most 54 contacts with 7 objects, 75 with 10
)
KEY_FRAMES = 8
"""Trajectories are padded to as many key frames, so that all primitives share one program."""
SAMPLES = 12
"""Sampled instants are padded likewise."""


@flax.struct.dataclass
class _State(Pytree):
    """What passes from one substep to the next."""

    qpos: jax.Array  # [6 + 7 N]
    qvel: jax.Array  # [6 + 6 N]
    warmstart: jax.Array  # [6 + 6 N]
    full: jax.Array  # [] bool: contacts or geom pairs were left out


@flax.struct.dataclass
class _Record(Pytree):
    """What is kept of a rollout; leading `[B]`."""

    poses: jax.Array  # [S, N, 7]
    gripper: jax.Array  # [S, 5]
    top: jax.Array  # [] m/s: highest speed of a present object
    broken: jax.Array  # [] bool


class MjxEngine:
    """See `physics.Engine`."""

    name = "mjx"

    def __init__(self, config: PhysicsConfig = DEFAULTS, *, chunk: int = 256) -> None:
        """An engine that compiles when it first meets a layout.

        Args:
          config: solver settings; the control period must be a whole number of time steps.
          chunk: most scenes simulated at once.

        Raises:
          UserError: the control period is not a whole number of time steps.
        """
        self.substeps = physics.substeps(config)
        prisms.register()
        self.config, self.chunk = config, chunk
        self.programs: dict[int, Callable[..., Rollout]] = {}  # by number of slots

    def simulate(
        self, scenes: Scene, poses: Array, trajectories: Trajectory, samples: Array, *, settle: bool = False
    ) -> Rollout:
        """See `physics.Engine.simulate`; numpy arrays out."""
        ticks = np.round(np.asarray(samples) / physics.CONTROL_PERIOD).astype(np.int32)
        padded = np.append(ticks, np.full(max(SAMPLES - len(ticks), 0), -1, np.int32))
        args = jax.tree.map(np.asarray, (scenes, poses, _pad(trajectories)))
        batch, slots = args[0].shape.shape
        if slots not in self.programs:
            with jax.numpy_rank_promotion("allow"):
                self.programs[slots] = jax.jit(_Program(self.config, slots, self.substeps).run)
        # powers of two, so that batches of many sizes share few programs
        size = min(1 << (batch - 1).bit_length(), self.chunk)
        done = []
        for start in range(0, batch, size):
            rows = np.minimum(np.arange(start, start + size), batch - 1)
            part = jax.tree.map(lambda leaf, rows=rows: leaf[rows], args)
            with jax.numpy_rank_promotion("allow"):  # MJX relies on it
                done.append(self.programs[slots](*part, padded, np.bool_(settle)))
        out = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves])[:batch], *done)
        return Rollout(out.poses[:, : len(ticks)], out.gripper[:, : len(ticks)], out.fault)


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
        self.config, self.slots, self.substeps = config, slots, substeps
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
            if key.types[0] != GeomType.PLANE and -1 < config.geom_pairs < len(pairs)
        ]

    def run(
        self, scenes: Scene, poses: jax.Array, trajectories: Trajectory, ticks: jax.Array, settle: jax.Array
    ) -> Rollout:
        """`MjxEngine.simulate` with padded key frames `[B, 8]` and sampled control ticks `[12]` (-1: none)."""
        present = scenes.shape >= 0
        fields = jax.vmap(self._fields)(scenes)
        start = jnp.where(present[..., None], poses, parked(self.slots))
        target = functools.partial(_control, trajectories)
        state = jax.vmap(self._initial)(start, target(0.0))
        record = _Record(
            jnp.zeros((len(poses), len(ticks), *poses.shape[1:])),
            jnp.zeros((len(poses), len(ticks), 5)),
            jnp.zeros(len(poses)),
            jnp.zeros(len(poses), bool),
        )

        def body(tick: jax.Array, carry: tuple[_State, _Record]) -> tuple[_State, _Record]:
            state, record = carry
            record = _store(record, state, ticks == tick)
            ctrl = target(tick * physics.CONTROL_PERIOD + GRIPPER.lag)
            state = jax.vmap(self._tick)(fields, state, ctrl)
            return state, _watch(record, state, present)

        last = ticks.max()
        state, record = jax.lax.fori_loop(0, last, body, (state, record))
        record = _store(record, state, ticks == last)
        end = target(last * physics.CONTROL_PERIOD)
        fault = _faults(scenes, state, record, end, settle)
        kept = jnp.where(present[:, None, :, None], record.poses, poses[:, None])
        return Rollout(kept, record.gripper, fault)

    def _initial(self, poses: jax.Array, ctrl: jax.Array) -> _State:
        rest = jnp.zeros(self.base.nv, jnp.float32)
        qpos = jnp.concatenate([ctrl, poses.reshape(-1)]).astype(jnp.float32)
        return _State(qpos, rest, rest, jnp.zeros((), bool))

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

    def _tick(self, fields: dict[str, Any], state: _State, ctrl: jax.Array) -> _State:
        """One control period of one scene."""
        m = self.base.tree_replace(fields)

        def substep(state: _State, _: None) -> tuple[_State, None]:
            d = self.data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)
            d = mjx.step(m, d)
            full = state.full | self._saturated(m, d)
            return jax.tree.map(_strong, _State(d.qpos, d.qvel, d.qacc_warmstart, full), state), None

        return jax.lax.scan(substep, state, None, length=self.substeps)[0]

    def _saturated(self, m: Any, d: Any) -> jax.Array:
        """Whether MJX may have left out a touching pair or a contact in this step; it says nothing itself."""
        contact, limit = d._impl.contact, self.config.contact_points
        full = jnp.zeros((), bool)
        for dim in np.unique(contact.dim):
            rows = contact.dim == dim
            if rows.sum() == limit:
                full |= (contact.dist[rows] < 0).all()
            full |= (contact.dist[rows] == prisms.LEFT_OUT).any()
        for first, second in (pairs.T for pairs in self.culled):
            apart = jnp.linalg.norm(d.geom_xpos[first] - d.geom_xpos[second], axis=-1)
            near = apart < m.geom_rbound[first] + m.geom_rbound[second]
            full |= near.sum() > self.config.geom_pairs
        return full


def _strong(new: jax.Array, old: jax.Array) -> jax.Array:
    """`new` with the type of `old`: MJX returns weak types, which a loop does not take."""
    return jnp.asarray(new).astype(old.dtype)


def _control(trajectories: Trajectory, time: Array | float) -> jax.Array:
    """Actuator set points `[B, 6]` at `time`: linear between key frames, gap split over both fingers."""

    def one(times: jax.Array, targets: jax.Array) -> jax.Array:
        index = jnp.clip((times <= time).sum() - 1, 0, len(times) - 2)
        span = jnp.maximum(times[index + 1] - times[index], 1e-9)
        weight = jnp.clip((time - times[index]) / span, 0.0, 1.0)
        pose = targets[index] * (1 - weight) + targets[index + 1] * weight
        return jnp.concatenate([pose[:4], pose[4:] / 2, pose[4:] / 2])

    return jax.vmap(one)(trajectories.time, trajectories.target)


def _store(record: _Record, state: _State, now: jax.Array) -> _Record:
    """Keep the present state in the samples `now [S]`."""
    gripper, poses = state.qpos[:, :GRIPPER_DOF], state.qpos[:, GRIPPER_DOF:]
    gripper = jnp.concatenate([gripper[:, :4], gripper[:, 4:].sum(-1, keepdims=True)], -1)
    poses = poses.reshape(record.poses.shape[:1] + record.poses.shape[2:])
    return record.replace(
        poses=jnp.where(now[None, :, None, None], poses[:, None], record.poses),
        gripper=jnp.where(now[None, :, None], gripper[:, None], record.gripper),
    )


def _watch(record: _Record, state: _State, present: jax.Array) -> _Record:
    velocity = state.qvel[:, GRIPPER_DOF:].reshape(*present.shape, 6)
    linear = jnp.where(present, jnp.linalg.norm(velocity[..., :3], axis=-1), 0.0).max(-1)
    finite = jnp.isfinite(state.qpos).all(-1) & jnp.isfinite(state.qvel).all(-1)
    top = jnp.maximum(record.top, jnp.where(finite, linear, 0.0))
    return record.replace(top=top, broken=record.broken | ~finite)


def _faults(scenes: Scene, state: _State, record: _Record, end: jax.Array, settle: jax.Array) -> jax.Array:
    """Fault codes `[B]`, as the native engine has them."""
    present = scenes.shape >= 0
    velocity = state.qvel[:, GRIPPER_DOF:].reshape(*present.shape, 6)
    linear, angular = (jnp.linalg.norm(v, axis=-1) for v in (velocity[..., :3], velocity[..., 3:]))
    speed = jnp.maximum(linear, angular * jnp.linalg.norm(scenes.size, axis=-1) / 2)
    position = state.qpos[:, GRIPPER_DOF:].reshape(*present.shape, 7)
    outside = (jnp.abs(position[..., :2]) > WORKSPACE.half).any(-1)
    lowest = shapes.lowest_corner(scenes.shape, scenes.size, position)
    flags = (
        (Fault.NON_FINITE, record.broken),
        (Fault.CAPACITY, state.full),
        (Fault.UNSETTLED, settle & (present & (speed > physics.REST_SPEED)).any(-1)),
        (Fault.OUTSIDE, (present & outside).any(-1)),
        (Fault.SPEED, record.top > physics.MAX_SPEED),
        (Fault.PENETRATION, (present & (lowest < -physics.MAX_SINK)).any(-1)),
        (Fault.SHORT, jnp.abs(state.qpos[:, :3] - end[:, :3]).max(-1) > physics.MAX_SHORT),
    )
    return sum((jnp.where(where, bit, 0) for bit, where in flags), jnp.zeros(len(present), jnp.int32))
