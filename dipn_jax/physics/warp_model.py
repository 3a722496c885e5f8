"""The MuJoCo Warp model of a batch: compiled once for a number of slots, then filled with the parts of its scenes.

Warp's fields of meshes have no world axis, so every part of every scene gets a mesh of its own, in the object's axes.
Parts of one class differ by scale alone: corners and normals are those of a template times a size, and what says which
corners are neighbours and which lie in one face (`Templates`) is shared.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float, Int

from dipn_jax.engine import PhysicsConfig
from dipn_jax.structs import ABSENT, Scene
from dipn_jax.world import model, shapes
from dipn_jax.world.model import GRIPPER_DOF

KINDS = [(shape, part) for shape in range(len(shapes.CLASSES)) for part in np.flatnonzero(shapes.CORNERS_USED[shape])]
"""All parts of all classes."""
VERTICES = 2 * shapes.CORNERS
"""Maximum number of corners of a part."""
FACES = shapes.CORNERS + 2
"""Maximum number of faces of a part."""
SHARED = ("mesh_graph", "mesh_polyvert", "mesh_polymap")
"""Fields of a MuJoCo model whose numbers count from the start of one mesh."""

SCENE_FIELDS = (
    *("geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound", "geom_dataid", "geom_friction"),
    *("pair_friction", "body_mass", "body_subtreemass", "body_inertia", "body_invweight0", "dof_invweight0"),
)
"""Fields that have a row a scene."""


@dataclasses.dataclass(frozen=True)
class Templates:
    """The parts of all classes at size 1, in the object's axes and from its centre of mass.

    K is `len(KINDS)`, V is VERTICES, F is FACES.
    """

    center: Float[np.ndarray, "K 3"]  # centre of volume
    corner: Float[np.ndarray, "K V 3"]  # from `center`; the first again where there are fewer
    normal: Float[np.ndarray, "K F 3"]
    counts: dict[str, Int[np.ndarray, " K"]]  # `mesh_vertnum`, `mesh_polynum`, and `mesh_graphadr` in `shared`
    places: dict[str, Int[np.ndarray, "K _"]]  # `mesh_polymap{adr,num}` a corner, `mesh_polyvert{adr,num}` a face
    shared: dict[str, Int[np.ndarray, " _"]]  # SHARED


@functools.cache
def templates() -> Templates:
    """Return the templates, which MuJoCo makes of their corners."""
    spec = mujoco.MjSpec()
    for shape, part in KINDS:
        rings = shapes.UNIT_VERTICES[shape, part].reshape(2, shapes.CORNERS, 3)
        spec.add_mesh(name=f"{shape} {part}", uservert=rings[:, : shapes.CORNERS_USED[shape, part]].ravel())
    made = spec.compile()
    turns = np.zeros((len(KINDS), 9))
    for turn, quat in zip(turns, made.mesh_quat, strict=True):
        mujoco.mju_quat2Mat(turn, quat)
    axes = turns.reshape(-1, 3, 3)

    def rows(name: str, start: np.ndarray, count: np.ndarray, width: int) -> np.ndarray:
        """Return a field of every mesh `[K, width, ...]`, padded with its first entry."""
        at = np.arange(width)
        values: np.ndarray = getattr(made, name)
        return values[start[:, None] + np.where(at < count[:, None], at, 0)]

    vertex = made.mesh_vertadr, made.mesh_vertnum, VERTICES
    face = made.mesh_polyadr, made.mesh_polynum, FACES
    return Templates(
        center=made.mesh_pos.astype(np.float32),
        corner=np.einsum("kij,kvj->kvi", axes, rows("mesh_vert", *vertex)).astype(np.float32),
        normal=np.einsum("kij,kvj->kvi", axes, rows("mesh_polynormal", *face)).astype(np.float32),
        counts={name: np.array(getattr(made, name)) for name in ("mesh_vertnum", "mesh_polynum", "mesh_graphadr")},
        places={name: rows(name, *vertex) for name in ("mesh_polymapadr", "mesh_polymapnum")}
        | {name: rows(name, *face) for name in ("mesh_polyvertadr", "mesh_polyvertnum")},
        shared={name: np.array(getattr(made, name)) for name in SHARED},
    )


def compiled(slots: int, config: PhysicsConfig, jacobian: mujoco.mjtJacobian) -> mujoco.MjModel:
    """Return the MuJoCo model of `slots` objects of no shape; `mesh_fields` and `scene_fields` say the rest."""
    nothing = Scene(np.full(slots, ABSENT), *np.ones((2, slots, 3)), *np.ones((2, slots)))
    spec = mujoco.MjSpec.from_string(model.mjcf(nothing, config=config, generic=True))
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp has no reset to disable
    spec.option.jacobian = jacobian
    return spec.compile()


def kinds(scenes: Scene) -> Int[np.ndarray, "B M"]:
    """Return which of KINDS each part of each slot of `scenes [B, N]` is, -1 where none is; M is N CONVEX_PARTS."""
    index = np.full((len(shapes.CLASSES), shapes.CONVEX_PARTS), -1, np.int32)
    index[shapes.CORNERS_USED > 0] = np.arange(len(KINDS))  # in the same order
    found = np.where((scenes.shape >= 0)[..., None], index[np.maximum(scenes.shape, 0)], -1)
    return found.reshape(len(found), -1)


def mesh_fields(kind: Int[np.ndarray, "B M"], size: Float[np.ndarray, "B M 3"]) -> dict[str, np.ndarray]:
    """Return the meshes of parts: fields of the model, of which mesh `b M + m` is part m of scene b.

    Args:
      kind: from `kinds`.
      size: metres, bounding boxes of the parts' objects.
    """
    made, kind = templates(), np.maximum(kind.ravel(), 0)
    size = size.reshape(-1, 1, 3)
    normal = made.normal[kind] / size
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return {
        "mesh_vert": (made.corner[kind] * size).reshape(-1, 3),
        "mesh_polynormal": normal.reshape(-1, 3),
        "mesh_vertadr": np.arange(len(kind)) * VERTICES,
        "mesh_polyadr": np.arange(len(kind)) * FACES,
        **{name: count[kind] for name, count in made.counts.items()},
        **{name: place[kind].ravel() for name, place in made.places.items()},
        **made.shared,
    }


def scene_fields(
    spec: mujoco.MjModel, scenes: Scene, kind: Int[np.ndarray, "B M"], size: Float[np.ndarray, "B M 3"]
) -> dict[str, np.ndarray]:
    """Return the fields of the model `spec` that have a row a scene, for `scenes [B, N]`; the rest as in `mesh_fields`.

    Rows are filled up to a power of two, at least two: kernels are compiled for their number, and only with more
    than one is a geom without a mesh left out.
    """
    batch, slots = scenes.shape.shape
    present = scenes.shape >= 0
    mass = np.where(present, scenes.mass, 0.1)
    mu = np.where(present, scenes.friction, 1.0).repeat(shapes.CONVEX_PARTS, -1)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), scenes)
    inertia = model.inertias(flat).reshape(*present.shape, 3)
    light = np.stack([1 / mass, (1 / inertia).mean(-1)], -1)  # inverse weights: translation, rotation
    geoms, bodies = slice(spec.ngeom - slots * shapes.CONVEX_PARTS, None), slice(spec.nbody - slots, None)
    mesh = np.where(kind >= 0, np.arange(kind.size).reshape(kind.shape), -1)
    changes: dict[str, tuple[tuple[slice | int, ...], np.ndarray]] = {
        **{name: ((geoms,), value) for name, value in _outlines(kind, size).items()},
        "geom_dataid": ((geoms,), mesh),
        "geom_friction": ((geoms, 0), mu * model.OBJECT_FRICTION_RATIO),
        "pair_friction": ((slice(None), slice(0, 2)), mu[..., None]),
        "body_mass": ((bodies,), mass),
        "body_subtreemass": ((bodies,), mass),
        "body_inertia": ((bodies,), inertia),
        "body_invweight0": ((bodies,), light),
        "dof_invweight0": ((slice(GRIPPER_DOF, None),), light.repeat(3, -1).reshape(batch, -1)),
    }
    out = {name: np.repeat(np.asarray(getattr(spec, name))[None], batch, 0) for name in changes}
    for name, (at, value) in changes.items():
        out[name][(slice(None), *at)] = value
    out["body_subtreemass"][:, 0] = out["body_mass"].sum(-1)
    rows = np.minimum(np.arange(row_count(batch)), batch - 1)
    return {name: value[rows] for name, value in out.items()}


def row_count(batch: int) -> int:
    """Return the number of rows of fields that have one a scene."""
    return max(2, 1 << (batch - 1).bit_length())


def _outlines(kind: Int[np.ndarray, "B M"], size: Float[np.ndarray, "B M 3"]) -> dict[str, np.ndarray]:
    """Return the fields of a geom that follow from its mesh `[B, M, ...]`: frame in the object's, and bounds."""
    made, known = templates(), np.maximum(kind, 0)
    low, high = (reach(made.corner, axis=1)[known] * size for reach in (np.min, np.max))
    reach = np.linalg.norm(made.corner[known] * size[..., None, :], axis=-1).max(-1)
    return {
        "geom_pos": made.center[known] * size,
        "geom_quat": np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*kind.shape, 4)),
        "geom_size": (high - low) / 2,
        "geom_aabb": np.concatenate([(high + low) / 2, (high - low) / 2], -1),
        "geom_rbound": reach,
    }


def put(warp: Any, made: Any, fields: dict[str, np.ndarray]) -> None:
    """Put fields into a Warp model: into its arrays if they are of this size, or else (of meshes, once) as new ones."""
    for name, value in fields.items():
        here = getattr(made, name)
        array = warp.array(value, dtype=here.dtype)
        if here.shape == array.shape:
            warp.copy(here, array)
        else:
            setattr(made, name, array)
