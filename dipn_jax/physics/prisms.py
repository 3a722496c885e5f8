"""Contacts of prisms whose vertices are traced values, for MJX.

MJX compiles the vertices of a mesh into the program, so each new shape would be a new compilation. Here the
mesh of a model is only a placeholder: `parts` computes the hull of every part inside the program, the engine
puts hulls with a leading geom axis in the model's place for meshes, and the colliders that `register` adds to
MJX's table gather them by geom. A model whose meshes have no such axis meets MJX's own colliders as before.

A geom whose `geom_size` is zero is dead: it never touches anything.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.mjx._src import collision_convex, collision_driver, math, mesh
from mujoco.mjx._src.collision_types import ConvexInfo, GeomInfo
from mujoco.mjx._src.types import ConvexMesh, GeomType

from dipn_jax.structs import Array, Pytree
from dipn_jax.world import shapes
from dipn_jax.world.shapes import CORNERS, CORNERS_USED, SIDES, UNIT_VERTICES

CONTACTS = 4
"""Contacts a pair of geoms can have."""
SKIN = 1e-3
"""Metres above the lowest corner within which corners count as touching a plane."""
MERGE = 1e-5
"""Metres: contacts of one pair nearer than this are one."""
NARROW = 12
"""Pairs of one kind (object-object, object-gripper) tested for edges, or two fifths where that is more; others must be
apart along a face."""
APART = 1.0
"""Distance reported where there is no contact."""
LEFT_OUT = 0.0
"""Distance reported for a pair that overlaps along all faces but was not among the NARROW: no contact, but a fault."""
PREFER_FACE = 5e-5
"""Metres by which two edges must be less deep than two faces to be the contact: faces give steady rest."""
PARALLEL = 1e-6
"""Squared sine of the angle between edges below which they are parallel."""
_DEAD_RADIUS = -1e3  # puts a geom last in the broad phase

Contacts = tuple[jax.Array, jax.Array, jax.Array]


@flax.struct.dataclass
class Parts(Pytree):
    """The convex parts of one object as MJX wants them: each about its own centre."""

    center: Float[Array, "*b P 3"]  # metres, object's frame: a point inside
    radius: Float[Array, "*b P"]  # metres: ball about the centre; negative where there is no part
    mesh: ConvexMesh  # leaves [P, ...], metres, relative to the centre
    alive: Bool[Array, "*b P"]  # whether there is such a part


def _faces() -> np.ndarray:
    """Corners of each face `[C, P, K + 2, K]`: sides (a repeated side in full), lower cap, upper cap."""
    sides = SIDES[..., None]
    after = (sides + 1) % CORNERS
    side = np.concatenate([sides, after, after + CORNERS, sides + CORNERS], -1)
    side = np.concatenate([side, np.repeat(side[..., -1:], CORNERS - 4, -1)], -1)
    ring = np.arange(CORNERS)
    caps = np.broadcast_to(np.stack([ring[::-1], ring + CORNERS]), (*SIDES.shape[:2], 2, CORNERS))
    return np.concatenate([side, caps], -2)


def _edges() -> tuple[np.ndarray, np.ndarray]:
    """Ends of each edge and the two faces beside it, both `[C, P, 3K, 2]`; a repeated corner's have no length."""
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
    """`table [C, P, ...]` with a copy of part 0 in place of every missing part, so that no value is degenerate."""
    missing = (CORNERS_USED == 0).reshape(CORNERS_USED.shape + (1,) * (table.ndim - 2))
    return np.where(missing, table[:, :1], table)


def _centers() -> np.ndarray:
    """Mean of the distinct corners of each part `[C, P, 3]` in units of the bounding box."""
    weight = (np.arange(CORNERS) < CORNERS_USED[..., None]) / np.maximum(CORNERS_USED[..., None], 1)
    return (np.concatenate([weight, weight], -1)[..., None] / 2 * UNIT_VERTICES).sum(-2)


_CENTERS = _complete(_centers())
_VERTICES = _complete(UNIT_VERTICES) - _CENTERS[:, :, None]
_FACES = _complete(_faces())
_EDGES, _BESIDE = (_complete(table) for table in _edges())


def parts(shape: Int[Array, ""] | int, size: Float[Array, " 3"]) -> Parts:
    """Hulls of one object's parts.

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


def _placed(hull: ConvexInfo, origin: jax.Array) -> ConvexInfo:
    """The hull in world axes, about `origin [3]`; faces as wide as a prism's."""
    shift, turn = hull.pos - origin, hull.mat.T
    face = jnp.pad(hull.face, ((0, 0), (0, CORNERS - hull.face.shape[1]), (0, 0)), "edge")
    return hull.replace(
        pos=shift,
        vert=hull.vert @ turn + shift,
        face=face @ turn + shift,
        face_normal=hull.face_normal @ turn,
        edge_face_normal=hull.edge_face_normal @ turn,
    )


def _merged(dist: jax.Array, pos: jax.Array, alive: jax.Array) -> jax.Array:
    """Distances `[4]`, APART unless negative, of a live geom and not at the place of an earlier contact."""
    near = jnp.linalg.norm(pos[:, None] - pos, axis=-1) < MERGE
    earlier = jnp.tril(near & (dist < 0), k=-1).any(-1)
    return jnp.where((dist < 0) & alive & ~earlier, dist, APART)


def plane_prism(plane: GeomInfo, prism: ConvexInfo) -> Contacts:
    """Up to four of the lowest corners of a prism against a plane.

    Args:
      plane: position and rotation; the normal is its z axis.
      prism: hull in its own frame, its position and rotation.

    Returns:
      Distances `[4]` (metres; APART where there is no contact), positions `[4, 3]` and frames `[4, 3, 3]`, world.
    """
    normal = plane.mat[:, 2]
    corners = prism.pos + prism.vert @ prism.mat.T
    height = (corners - plane.pos) @ normal
    low = height < height.min() + SKIN
    chosen = collision_convex._manifold_points(corners, low, normal)
    dist = _merged(height[chosen], corners[chosen], prism.size[0] > 0)
    pos = corners[chosen] - 0.5 * height[chosen][:, None] * normal
    return dist, pos, jnp.broadcast_to(math.make_frame(normal), (CONTACTS, 3, 3))


def _face_gaps(first: ConvexInfo, second: ConvexInfo) -> tuple[jax.Array, jax.Array]:
    """Distance from the planes of the first `[F]` and of the second `[G]` to the other hull, negative: overlap."""

    def gaps(planes: ConvexInfo, other: ConvexInfo) -> jax.Array:
        offset = (planes.face_normal * planes.face[:, 0]).sum(-1)
        return (other.vert @ planes.face_normal.T).min(0) - offset

    return gaps(first, second), gaps(second, first)


def face_gap(first: ConvexInfo, second: ConvexInfo) -> jax.Array:
    """Largest distance `[]` between two hulls along a face normal of either: positive means apart."""
    gaps = _face_gaps(_placed(first, second.pos), _placed(second, second.pos))
    alive = (first.size[0] > 0) & (second.size[0] > 0)
    return jnp.where(alive, jnp.concatenate(gaps).max(), APART)


def _outer(a: jax.Array, b: jax.Array) -> list[jax.Array]:
    """Cross products of every row of `a [E, 3]` with every row of `b [F, 3]`, as three arrays `[E, F]`."""
    return [
        a[:, None, (i + 1) % 3] * b[None, :, (i + 2) % 3] - a[:, None, (i + 2) % 3] * b[None, :, (i + 1) % 3]
        for i in range(3)
    ]


def _edge_contact(first: ConvexInfo, second: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Gap `[]`, axis `[3]` from first to second and middle `[3]` of the pair of edges with the largest gap.

    Only pairs whose arcs on the Gauss map cross can carry a contact (D. Gregorius, "The separating axis test
    between convex polyhedra", GDC 2013). Gap -inf where there is no such pair.
    """
    ends_a, ends_b = first.vert[first.edge], second.vert[second.edge]
    a1, a2 = first.edge_face_normal[:, 0], first.edge_face_normal[:, 1]
    b1, b2 = -second.edge_face_normal[:, 0], -second.edge_face_normal[:, 1]
    along_a, along_b = jnp.cross(a1, a2), jnp.cross(b1, b2)
    side_b1, side_b2 = along_a @ b1.T, along_a @ b2.T
    side_a1, side_a2 = a1 @ along_b.T, a2 @ along_b.T
    crossing = (side_b1 * side_b2 < 0) & (side_a1 * side_a2 < 0) & (side_b1 * side_a2 > 0)
    unit_a, unit_b = (jax.vmap(math.normalize)(e[:, 1] - e[:, 0]) for e in (ends_a, ends_b))
    return _best_edges(ends_a, ends_b, _outer(unit_a, unit_b), crossing, first.pos)


def _best_edges(
    ends_a: jax.Array, ends_b: jax.Array, axes: list[jax.Array], usable: jax.Array, center: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """See `_edge_contact`; `axes` are three arrays `[E, F]`, `center [3]` a point inside the first hull."""
    square = axes[0] ** 2 + axes[1] ** 2 + axes[2] ** 2
    out = sum(axes[i] * (ends_a[:, 0, i] - center[i])[:, None] for i in range(3))
    between = sum(axes[i] * (ends_b[None, :, 0, i] - ends_a[:, None, 0, i]) for i in range(3))
    scale = jnp.sign(out) * jax.lax.rsqrt(jnp.maximum(square, PARALLEL))
    gap = jnp.where(usable & (square > PARALLEL), between * scale, -jnp.inf)
    row, col = jnp.unravel_index(gap.argmax(), gap.shape)
    axis = jnp.stack([x[row, col] for x in axes]) * scale[row, col]
    points = math.closest_segment_to_segment_points(*ends_a[row], *ends_b[col])
    return gap[row, col], axis, (points[0] + points[1]) / 2


def convex_prism(first: ConvexInfo, second: ConvexInfo) -> Contacts:
    """Contacts of two hulls by separating axes: up to four of face against face, or one of edge against edge.

    Args:
      first: hull in its own frame, its position and rotation.
      second: the other.

    Returns:
      As `plane_prism`; the frame's x axis points from the first to the second.
    """
    origin = second.pos
    a, b = _placed(first, origin), _placed(second, origin)
    gap_a, gap_b = _face_gaps(a, b)
    reference = jnp.where(gap_a.max() >= gap_b.max(), 1.0, -1.0)
    normal = jnp.where(reference > 0, a.face_normal[gap_a.argmax()], b.face_normal[gap_b.argmax()])
    face = jnp.where(reference > 0, a.face[gap_a.argmax()], b.face[gap_b.argmax()])
    facing_a, facing_b = (a.face_normal @ normal).argmin(), (b.face_normal @ normal).argmin()
    other = jnp.where(reference > 0, b.face[facing_b], a.face[facing_a])
    other_normal = jnp.where(reference > 0, b.face_normal[facing_b], a.face_normal[facing_a])
    dist, pos, _ = collision_convex._create_contact_manifold(face, other, normal, other_normal, normal)
    pos = pos + 0.5 * dist[:, None] * normal  # from the reference face to halfway
    edge_gap, edge_axis, edge_pos = _edge_contact(a, b)
    face_gap = jnp.maximum(gap_a.max(), gap_b.max())
    edge = edge_gap > face_gap + PREFER_FACE
    dist = jnp.where(edge, jnp.array([0.0, 1.0, 1.0, 1.0]) + edge_gap, jnp.where(face_gap < 0, dist, APART))
    pos = jnp.where(edge, edge_pos, pos)
    alive = (first.size[0] > 0) & (second.size[0] > 0)
    frame = math.make_frame(jnp.where(edge, edge_axis, reference * normal))
    dist = _merged(dist, pos, alive)
    pos = jnp.where((dist < 0)[:, None], pos, 0.0)  # elsewhere it may be huge, and MJX multiplies it by zero
    return dist, pos + origin, jnp.broadcast_to(frame, (CONTACTS, 3, 3))


def _gather(m: Any, d: Any, key: Any, geom: jax.Array) -> tuple[list[Any], list[Any]]:
    """Geometry of both geoms of the pairs `geom [G, 2]`, and the axes to map each over."""
    infos, axes = [], []
    for i, kind in enumerate(key.types):
        info = GeomInfo(d.geom_xpos[geom[:, i]], d.geom_xmat[geom[:, i]], m.geom_size[geom[:, i]])
        axis: Any = 0
        if kind == GeomType.MESH:
            hulls = jax.tree.map(lambda leaf, i=i: leaf[geom[:, i]], m._impl.mesh_convex[key.data_ids[i]])
            info = ConvexInfo(**vars(info), **vars(hulls))
        elif kind == GeomType.BOX:
            info = mesh.box(info)
            axis = jax.tree.map(lambda _: None, info).replace(pos=0, mat=0, size=0, face=0, vert=0)
        infos.append(info)
        axes.append(axis)
    return infos, axes


def _narrow(m: Any, d: Any, key: Any, geom: jax.Array) -> Contacts:
    """`convex_prism` for the NARROW most overlapping of the pairs `geom [G, 2]`; results for all of them."""
    pairs, axes = _gather(m, d, key, geom)
    gap = jax.vmap(face_gap, in_axes=axes)(*pairs)
    _, chosen = jax.lax.top_k(-gap, min(max(NARROW, 2 * len(geom) // 5), len(geom)))
    pairs, axes = _gather(m, d, key, geom[chosen])
    found = jax.vmap(convex_prism, in_axes=axes)(*pairs)
    rest = jnp.where(gap < 0, LEFT_OUT, APART)
    dist = jnp.broadcast_to(rest[:, None], (len(geom), CONTACTS)).at[chosen].set(found[0])
    pos = jnp.zeros((len(geom), CONTACTS, 3)).at[chosen].set(found[1])
    frame = jnp.broadcast_to(jnp.eye(3), (len(geom), CONTACTS, 3, 3)).at[chosen].set(found[2])
    return dist, pos, frame


def _collider(upstream: Callable[..., Any]) -> Callable[..., Any]:
    def collide(m: Any, d: Any, key: Any, geom: jax.Array) -> Any:
        if m._impl.mesh_convex[key.data_ids[1]].vert.ndim == 2:
            return upstream(m, d, key, geom)
        if key.types[0] == GeomType.PLANE:
            found = jax.vmap(plane_prism)(*_gather(m, d, key, geom)[0])
        else:
            found = _narrow(m, d, key, geom)
        return jax.tree.map(jnp.concatenate, found)

    collide.ncon = CONTACTS  # type: ignore[attr-defined]  # MJX reads it
    collide.upstream = upstream  # type: ignore[attr-defined]
    return collide


def register() -> None:
    """Put the colliders of this module in MJX's table; a second call changes nothing."""
    table = collision_driver._COLLISION_FUNC
    for kind in (GeomType.PLANE, GeomType.BOX, GeomType.MESH):
        upstream = table[kind, GeomType.MESH]
        if not hasattr(upstream, "upstream"):
            table[kind, GeomType.MESH] = _collider(upstream)
