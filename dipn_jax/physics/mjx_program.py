"""The traced rollout of a batch of scenes in MJX, for one number of object slots."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver
from mujoco.mjx._src.types import GeomType

from dipn_jax import physics
from dipn_jax.engine import PhysicsConfig
from dipn_jax.physics import colliders, faults, prisms, recording
from dipn_jax.physics.recording import Record, State
from dipn_jax.physics.tick import Tick, scene_fields
from dipn_jax.structs import Array, Rollout, Scene, Trajectory
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import model, shapes
from dipn_jax.world.model import GRIPPER_DOF
from dipn_jax.world.scenes import parked


def _adapt(spec: mujoco.MjModel) -> None:
    """Change settings of the MJCF that would cost MJX time without any gain."""
    # MJX keeps `contact_points` rows for each condim: with the pads at 4 the solver has 2.5 times the rows and a step
    # takes 1.6 times as long, for a torsional friction that the several contacts of a pad have without it
    spec.geom_condim[spec.geom_condim == 4] = 3


class Program:
    """The traced rollout for one number of slots, with the placeholder model that it fills in for every scene."""

    def __init__(self, config: PhysicsConfig, slots: int, substeps: int) -> None:
        self.slots, self.substeps = slots, substeps
        self.pairs, self.contacts = config.caps(slots)
        full = np.full(slots, 0.1, np.float32)
        scene = Scene(np.zeros(slots, np.int32), np.full((slots, 3), 0.05), np.zeros((slots, 3)), full, full)
        spec = mujoco.MjModel.from_xml_string(model.mjcf(scene, config=config, generic=True))
        _adapt(spec)
        by_kernel = config.solver == "warp"
        self.kernel = Tick(spec, slots=slots, contacts=self.contacts, substeps=substeps) if by_kernel else None
        self.base = mjx.put_model(spec, impl="jax")
        self.first_geom, self.first_body = spec.ngeom - slots * shapes.CONVEX_PARTS, spec.nbody - slots
        if self.kernel is not None:
            return
        self.data = mjx.make_data(self.base)
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
        """Simulate as `MjxEngine.simulate` says, with padded arguments.

        Args:
          scenes: `[B, N]`.
          poses: `[B, N, 7]`.
          trajectories: key frames `[B, 8]`.
          room: memory for the poses and the gripper of a record.
          ticks: `[12]` control ticks to sample at (-1: none).
          settle: see `Engine.simulate`.
          fence: seconds from the start.
        """
        present = scenes.shape >= 0
        fields = jax.vmap(self._fields)(scenes)
        start = jnp.where(present[..., None], poses, parked(self.slots))
        mass = jnp.where(present, scenes.mass, 0.0)
        target = functools.partial(recording.control, trajectories)
        state = jax.vmap(self._initial)(start, target(0.0))
        none = jnp.zeros(len(poses))
        record = Record(*room, top=none, stray=none, broken=none > 0, deepest=none)

        # in whole ticks: in float32 ten periods are less than a tenth of a second
        fenced, grace = jnp.round(fence / physics.CONTROL_PERIOD), round(faults.GRACE_TIME / physics.CONTROL_PERIOD)

        def body(tick: jax.Array, carry: tuple[State, Record]) -> tuple[State, Record]:
            state, record = carry
            record = recording.store(record, state, ticks == tick)
            ctrl = target(tick * physics.CONTROL_PERIOD + GRIPPER.lag)
            force = jnp.where(tick < fenced, recording.fence_forces(mass, state), 0.0)
            state = jax.vmap(self._tick)(fields, state, ctrl, force)
            due = target((tick + 1) * physics.CONTROL_PERIOD)
            return state, recording.watch(record, state, scenes, due, deep=tick >= jnp.maximum(fenced, grace))

        last = ticks.max()
        state, record = jax.lax.fori_loop(0, last, body, (state, record))
        record = recording.store(record, state, ticks == last)
        fault = self._fault(scenes, state, record, target(last * physics.CONTROL_PERIOD), settle)
        kept = jnp.where(present[:, None, :, None], record.poses, poses[:, None])
        return Rollout(kept, record.gripper, fault)

    def _fault(self, scenes: Scene, state: State, record: Record, target: jax.Array, settle: jax.Array) -> Array:
        """Return fault codes `[B]` at the end of a rollout, where the gripper should be at `target [B, 6]`."""
        return faults.codes(
            scenes,
            state.qpos[:, GRIPPER_DOF:].reshape(*scenes.shape.shape, 7),
            recording.velocity(state, scenes),
            state.qpos[:, :3],
            target[:, :3],
            top=record.top,
            stray=record.stray,
            broken=record.broken,
            full=state.full,
            depth=state.depth,
            deepest=record.deepest,
            settle=settle,
        )

    def _initial(self, poses: jax.Array, ctrl: jax.Array) -> State:
        rest = jnp.zeros(self.base.nv, jnp.float32)
        qpos = jnp.concatenate([ctrl, poses.reshape(-1)]).astype(jnp.float32)
        return State(qpos, rest, rest, jnp.zeros((), bool), jnp.zeros((), jnp.float32))

    def _fields(self, scene: Scene) -> dict[str, Any]:
        """Return the leaves of the model that depend on the scene, by their name in it."""
        base, present = self.base, scene.shape >= 0
        parts = jax.vmap(prisms.parts)(scene.shape, scene.size)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), parts)
        mass = jnp.where(present, scene.mass, 0.1)
        inertia = jnp.where(present[:, None], jax.vmap(shapes.inertia)(scene.shape, scene.size, mass), 1e-4)
        mu = jnp.where(present, scene.friction, 1.0).repeat(shapes.CONVEX_PARTS)
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
            "_impl.mesh_convex": (self._hulls(flat.mesh),),
        }

    def _hulls(self, parts: Any) -> Any:
        """Return the hulls of all geoms: of the gripper's boxes (the kernel reads them), then `parts [3 N, ...]`.

        The first row is of the floor; it has no size, and nothing reads it.
        """
        sides = 2 * self.base.geom_size[: self.first_geom]
        boxes = jax.vmap(functools.partial(prisms.parts, shapes.CLASSES.index("cuboid")))(sides).mesh
        return jax.tree.map(lambda box, part: jnp.concatenate([box[:, 0], part]), boxes, parts)

    def _tick(self, fields: dict[str, Any], state: State, ctrl: jax.Array, force: jax.Array) -> State:
        """Advance one scene by one control period."""
        if self.kernel is not None:
            return self.kernel.advance(scene_fields(fields), state, ctrl, force)
        m = self.base.tree_replace(fields)
        each = functools.partial(self._substep, m, ctrl, force)
        return jax.lax.scan(lambda state, _: (each(state), None), state, None, length=self.substeps)[0]

    def _substep(self, m: Any, ctrl: jax.Array, force: jax.Array, state: State) -> State:
        """Advance one scene by one time step of MJX."""
        d = self.data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)
        d = mjx.step(m, d.replace(ctrl=ctrl, qfrc_applied=force))
        full = state.full | self._saturated(m, d)
        depth = jnp.maximum(0.0, -d._impl.contact.dist.min())
        return jax.tree.map(_strong, State(d.qpos, d.qvel, d.qacc_warmstart, full, depth), state)

    def _saturated(self, m: Any, d: Any) -> jax.Array:
        """Return whether MJX may have left out a touching pair or a contact in this step, which it does not report."""
        contact, limit = d._impl.contact, self.contacts
        full = jnp.zeros((), bool)
        for dim in np.unique(contact.dim):
            rows = contact.dim == dim
            if rows.sum() == limit:
                full |= (contact.dist[rows] < 0).all()
            full |= (contact.dist[rows] == colliders.LEFT_OUT_DISTANCE).any()
        for first, second in (pairs.T for pairs in self.culled):
            apart = jnp.linalg.norm(d.geom_xpos[first] - d.geom_xpos[second], axis=-1)
            near = apart < m.geom_rbound[first] + m.geom_rbound[second]
            full |= near.sum() > self.pairs
        return full


def _strong(new: jax.Array, old: jax.Array) -> jax.Array:
    """Return `new` with the type of `old`: MJX returns weak types, which a loop refuses."""
    return jnp.asarray(new).astype(old.dtype)
