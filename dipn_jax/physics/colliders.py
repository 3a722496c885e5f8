"""Contacts of traced hulls (`prisms`) with planes, boxes and one another, for MJX.

`patches` puts `collide` into MJX's table of colliders, for models whose meshes are traced. A geom whose `geom_size` is
zero is dead: it never touches anything.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from mujoco.mjx._src import collision_convex, math, mesh
from mujoco.mjx._src.collision_types import ConvexInfo, GeomInfo
from mujoco.mjx._src.types import GeomType

from dipn_jax.world.shapes import CORNERS

CONTACTS_PER_PAIR = 4
"""Contacts that a pair of geoms can have."""
TOUCHING_HEIGHT = 1e-3
"""Metres above the lowest corner within which corners count as touching a plane."""
SAME_CONTACT_DISTANCE = 1e-5
"""Metres: contacts of one pair nearer than this are one."""
FEWEST_EDGE_TESTS = 12
"""Pairs of one kind (object-object, object-gripper) whose edges are tested, or two fifths of the pairs where that is
more; for the others, only being apart along a face is recognized."""
APART_DISTANCE = 1.0
"""Distance reported where there is no contact."""
LEFT_OUT_DISTANCE = 0.0
"""Distance reported for a pair that overlaps along all faces but had no edges tested: no contact, but a fault."""
FACE_PREFERENCE = 5e-5
"""Metres by which two edges must be less deep than two faces to be the contact: faces give steady rest."""
PARALLEL_SQUARED_SINE = 1e-6
"""Squared sine of the angle between edges below which they are parallel."""

Contacts = tuple[jax.Array, jax.Array, jax.Array]
"""Distances, positions and frames."""


def _placed(hull: ConvexInfo, origin: jax.Array) -> ConvexInfo:
    """Return the hull in world axes about `origin [3]`; its faces get as many corners as a prism's."""
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
    """Return distances `[4]`, with APART_DISTANCE for no contact, a repeated contact and a dead geom."""
    near = jnp.linalg.norm(pos[:, None] - pos, axis=-1) < SAME_CONTACT_DISTANCE
    earlier = jnp.tril(near & (dist < 0), k=-1).any(-1)
    return jnp.where((dist < 0) & alive & ~earlier, dist, APART_DISTANCE)


def plane_prism(plane: GeomInfo, prism: ConvexInfo) -> Contacts:
    """Return contacts of up to four of the lowest corners of a prism with a plane.

    Args:
      plane: position and rotation; the normal is its z axis.
      prism: hull in its own frame, its position and rotation.

    Returns:
      Distances `[4]` (metres; APART_DISTANCE where there is no contact), positions `[4, 3]` and frames `[4, 3, 3]`,
      world.
    """
    normal = plane.mat[:, 2]
    corners = prism.pos + prism.vert @ prism.mat.T
    height = (corners - plane.pos) @ normal
    low = height < height.min() + TOUCHING_HEIGHT
    chosen = collision_convex._manifold_points(corners, low, normal)
    dist = _merged(height[chosen], corners[chosen], prism.size[0] > 0)
    pos = corners[chosen] - 0.5 * height[chosen][:, None] * normal
    return dist, pos, jnp.broadcast_to(math.make_frame(normal), (CONTACTS_PER_PAIR, 3, 3))


def _face_gaps(first: ConvexInfo, second: ConvexInfo) -> tuple[jax.Array, jax.Array]:
    """Return distances from the planes of the first `[F]` and the second `[G]` to the other hull; negative: overlap."""

    def gaps(planes: ConvexInfo, other: ConvexInfo) -> jax.Array:
        offset = (planes.face_normal * planes.face[:, 0]).sum(-1)
        return (other.vert @ planes.face_normal.T).min(0) - offset

    return gaps(first, second), gaps(second, first)


def face_gap(first: ConvexInfo, second: ConvexInfo) -> jax.Array:
    """Return the largest distance `[]` between two hulls along a face normal of either; positive: they are apart."""
    gaps = _face_gaps(_placed(first, second.pos), _placed(second, second.pos))
    alive = (first.size[0] > 0) & (second.size[0] > 0)
    return jnp.where(alive, jnp.concatenate(gaps).max(), APART_DISTANCE)


def _outer(a: jax.Array, b: jax.Array) -> list[jax.Array]:
    """Return cross products of every row of `a [E, 3]` with every row of `b [F, 3]`, as three arrays `[E, F]`."""
    return [
        a[:, None, (i + 1) % 3] * b[None, :, (i + 2) % 3] - a[:, None, (i + 2) % 3] * b[None, :, (i + 1) % 3]
        for i in range(3)
    ]


def _edge_contact(first: ConvexInfo, second: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return gap `[]`, axis `[3]` (first to second) and middle `[3]` of the pair of edges with the largest gap.

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
    """Return what `_edge_contact` does; `axes` are three arrays `[E, F]`, `center [3]` is a point in the first hull."""
    square = axes[0] ** 2 + axes[1] ** 2 + axes[2] ** 2
    out = sum(axes[i] * (ends_a[:, 0, i] - center[i])[:, None] for i in range(3))
    between = sum(axes[i] * (ends_b[None, :, 0, i] - ends_a[:, None, 0, i]) for i in range(3))
    scale = jnp.sign(out) * jax.lax.rsqrt(jnp.maximum(square, PARALLEL_SQUARED_SINE))
    gap = jnp.where(usable & (square > PARALLEL_SQUARED_SINE), between * scale, -jnp.inf)
    row, col = jnp.unravel_index(gap.argmax(), gap.shape)
    axis = jnp.stack([x[row, col] for x in axes]) * scale[row, col]
    points = math.closest_segment_to_segment_points(*ends_a[row], *ends_b[col])
    return gap[row, col], axis, (points[0] + points[1]) / 2


def convex_prism(first: ConvexInfo, second: ConvexInfo) -> Contacts:
    """Return contacts of two hulls by separating axes: up to four of face against face, or one of edge against edge.

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
    edge = edge_gap > face_gap + FACE_PREFERENCE
    dist = jnp.where(edge, jnp.array([0.0, 1.0, 1.0, 1.0]) + edge_gap, jnp.where(face_gap < 0, dist, APART_DISTANCE))
    pos = jnp.where(edge, edge_pos, pos)
    alive = (first.size[0] > 0) & (second.size[0] > 0)
    frame = math.make_frame(jnp.where(edge, edge_axis, reference * normal))
    dist = _merged(dist, pos, alive)
    pos = jnp.where((dist < 0)[:, None], pos, 0.0)  # elsewhere it may be huge, and MJX multiplies it by zero
    return dist, pos + origin, jnp.broadcast_to(frame, (CONTACTS_PER_PAIR, 3, 3))


def _gather(m: Any, d: Any, key: Any, geom: jax.Array) -> tuple[list[Any], list[Any]]:
    """Return the geometry of both geoms of the pairs `geom [G, 2]`, and the axes to map each over."""
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
    """Return contacts of all pairs `geom [G, 2]`; only the most overlapping (FEWEST_EDGE_TESTS) get `convex_prism`."""
    pairs, axes = _gather(m, d, key, geom)
    gap = jax.vmap(face_gap, in_axes=axes)(*pairs)
    _, chosen = jax.lax.top_k(-gap, min(max(FEWEST_EDGE_TESTS, 2 * len(geom) // 5), len(geom)))
    pairs, axes = _gather(m, d, key, geom[chosen])
    found = jax.vmap(convex_prism, in_axes=axes)(*pairs)
    rest = jnp.where(gap < 0, LEFT_OUT_DISTANCE, APART_DISTANCE)
    dist = jnp.broadcast_to(rest[:, None], (len(geom), CONTACTS_PER_PAIR)).at[chosen].set(found[0])
    pos = jnp.zeros((len(geom), CONTACTS_PER_PAIR, 3)).at[chosen].set(found[1])
    frame = jnp.broadcast_to(jnp.eye(3), (len(geom), CONTACTS_PER_PAIR, 3, 3)).at[chosen].set(found[2])
    return dist, pos, frame


def is_traced(m: Any, kind: Any) -> bool:
    """Return whether the meshes of a model are hulls of `parts`, one a geom: its arrays then have a geom axis first."""
    return m._impl.mesh_convex[kind.data_ids[1]].vert.ndim == 3


def collide(m: Any, d: Any, kind: Any, geom: jax.Array) -> Contacts:
    """Find the contacts of pairs of geoms of one kind; arguments and result as of a collider of MJX.

    Args:
      m: MJX model whose meshes are traced (`is_traced`).
      d: its data, with the geoms' places.
      kind: what the pairs are, a `FunctionKey` of MJX: a plane, a box or a mesh, and a mesh.
      geom: `[G, 2]` geoms of each pair.

    Returns:
      As `plane_prism`, for all pairs: `[4 G]`, `[4 G, 3]` and `[4 G, 3, 3]`.
    """
    if kind.types[0] == GeomType.PLANE:
        found = jax.vmap(plane_prism)(*_gather(m, d, kind, geom)[0])
    else:
        found = _narrow(m, d, kind, geom)
    distance, position, frame = jax.tree.map(jnp.concatenate, found)
    return distance, position, frame
