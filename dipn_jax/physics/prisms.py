"""Convex hulls of the objects' parts as traced values, for MJX.

MJX compiles the vertices of a mesh into the program, so each new shape would be a new compilation. Here the mesh of a
model is only a placeholder: `parts` computes the hull of every part inside the program, the engine replaces the model's
meshes by these hulls, one a geom, and the functions in `colliders` find their contacts.

A geom whose `geom_size` is zero is dead: it never touches anything.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.mjx._src.types import ConvexMesh

from dipn_jax.structs import Array, Pytree
from dipn_jax.world import shapes
from dipn_jax.world.shapes import CORNERS, CORNERS_USED, SIDES, UNIT_VERTICES

_DEAD_RADIUS = -1e3
"""Metres: radius of a geom that is no part of an object, which the broad phase of MJX then puts last."""


@flax.struct.dataclass
class Parts(Pytree):
    """The convex parts of one object in the form that MJX takes: each about its own centre."""

    center: Float[Array, "*b P 3"]  # metres, object's frame: a point inside
    radius: Float[Array, "*b P"]  # metres: ball about the centre; negative where there is no part
    mesh: ConvexMesh  # leaves [P, ...], metres, relative to the centre
    alive: Bool[Array, "*b P"]  # whether there is such a part


def _faces() -> np.ndarray:
    """Return the corners of each face `[C, P, K + 2, K]`: sides (a repeated side in full), lower cap, upper cap."""
    sides = SIDES[..., None]
    after = (sides + 1) % CORNERS
    side = np.concatenate([sides, after, after + CORNERS, sides + CORNERS], -1)
    side = np.concatenate([side, np.repeat(side[..., -1:], CORNERS - 4, -1)], -1)
    ring = np.arange(CORNERS)
    caps = np.broadcast_to(np.stack([ring[::-1], ring + CORNERS]), (*SIDES.shape[:2], 2, CORNERS))
    return np.concatenate([side, caps], -2)


def _edges() -> tuple[np.ndarray, np.ndarray]:
    """Return ends and faces of each edge, `[C, P, 3K, 2]` each; the edges of repeated corners have no length."""
    i = np.arange(CORNERS)
    last = CORNERS_USED[..., None] - 1  # the last distinct corner
    after = np.broadcast_to((i + 1) % CORNERS, SIDES.shape)
    lower = np.stack([np.broadcast_to(i, SIDES.shape), after], -1)
    up = np.where(i > last, i, i + CORNERS)
    rise = np.stack([np.broadcast_to(i, SIDES.shape), up], -1)
    left, right = (i - 1) % CORNERS, np.where(i == last, CORNERS - 1, i)
    left_face = np.take_along_axis(SIDES, np.broadcast_to(left, SIDES.shape), -1)
    beside = np.stack([left_face, np.take_along_axis(SIDES, right, -1)], -1)
    caps = [np.stack([SIDES, np.full_like(SIDES, CORNERS + cap)], -1) for cap in (0, 1)]
    return np.concatenate([lower, lower + CORNERS, rise], -2), np.concatenate([*caps, beside], -2)


def _complete(table: np.ndarray) -> np.ndarray:
    """Return `table [C, P, ...]` with a copy of part 0 for every missing part, so that no value is degenerate."""
    missing = (CORNERS_USED == 0).reshape(CORNERS_USED.shape + (1,) * (table.ndim - 2))
    return np.where(missing, table[:, :1], table)


def _centers() -> np.ndarray:
    """Return the mean of the distinct corners of each part `[C, P, 3]` in units of the bounding box."""
    weight = (np.arange(CORNERS) < CORNERS_USED[..., None]) / np.maximum(CORNERS_USED[..., None], 1)
    return (np.concatenate([weight, weight], -1)[..., None] / 2 * UNIT_VERTICES).sum(-2)


_CENTERS = _complete(_centers())
_VERTICES = _complete(UNIT_VERTICES) - _CENTERS[:, :, None]
_FACES = _complete(_faces())
_EDGES, _BESIDE = (_complete(table) for table in _edges())


def parts(shape: Int[Array, ""] | int, size: Float[Array, " 3"]) -> Parts:
    """Return the hulls of one object's parts.

    Args:
      shape: index into `shapes.CLASSES`; ABSENT gives dead parts.
      size: metres, bounding box.

    Returns:
      Parts with leaves `[P, ...]`, relative to each part's centre. Values of dead parts are finite.
    """
    index = jnp.maximum(shape, 0)

    def row(table: np.ndarray) -> jax.Array:
        return jnp.asarray(table, jnp.float32 if table.dtype.kind == "f" else jnp.int32)[index]

    vertices = row(_VERTICES) * size
    hull = shapes.hull(shape, size)
    normals = jnp.where(hull.alive[:, None, None], hull.normals, hull.normals[:1])
    faces = jax.vmap(lambda corners, at: corners[at])(vertices, row(_FACES))
    beside = jax.vmap(lambda normal, at: normal[at])(normals, row(_BESIDE))
    radius = jnp.where(hull.alive, jnp.linalg.norm(vertices, axis=-1).max(-1), _DEAD_RADIUS)
    return Parts(row(_CENTERS) * size, radius, ConvexMesh(vertices, faces, normals, row(_EDGES), beside), hull.alive)
