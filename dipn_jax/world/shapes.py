"""The catalogue of objects, each made of one or more convex prisms.

A class is defined once, in a unit cube, as up to `CONVEX_PARTS` convex polygons extruded along one axis; an
object is its class stretched to its bounding box. An object's frame is at its centre of mass, along the
axes of the box. Everything downstream (MuJoCo model,
collision hulls, renderer) reads the same vertices, so sizes and even classes can be traced values.

Round shapes are regular prisms: MJX has no collision between a cylinder and a mesh, and twelve
corners still roll where friction is above tan(15 deg) = 0.27.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from dipn_jax.structs import Array, Pytree

CLASSES = ("cuboid", "cylinder", "half_cylinder", "triangular_prism", "concave")
"""Classes of shapes; `Scene.shape` is an index into them."""
CORNERS = 12
"""Largest number of corners of a part's cross-section."""
CONVEX_PARTS = 3
"""Largest number of convex parts of an object."""

Polygon = list[tuple[float, float]]
"""Corners, counter-clockwise."""


def _arc(start: float, stop: float, count: int) -> np.ndarray:
    angle = np.deg2rad(np.linspace(start, stop, count))
    return np.stack([np.cos(angle), np.sin(angle)], -1) / 2


def _half_disc() -> Polygon:
    """Return a half disc with its flat face down, bounding box [-1/2, 1/2]^2, in (z, x) for an extrusion along y."""
    xz = _arc(0, 180, CORNERS - 1) * np.array([1.0, 2.0]) - np.array([0.0, 0.5])
    return [(z, x) for x, z in xz[::-1]]  # mirrored by the swap, hence reversed: counter-clockwise again


def _notched() -> list[Polygon]:
    """Return the arch in (z, x): a 100 x 50 mm face with a trapezoid for its half-round notch of 26 mm.

    The trapezoid has the area and the depth of the half disc.
    """
    rim, floor, depth = 0.26, 0.148, 0.02  # of 100 mm, of 100 mm, and x = -1 mm of 50 mm
    left = [(-0.5, -0.5), (-floor, -0.5), (-floor, -depth), (-rim, 0.5), (-0.5, 0.5)]
    right = [(-u, v) for u, v in reversed(left)]
    middle = [(-floor, -0.5), (floor, -0.5), (floor, -depth), (-floor, -depth)]
    return [left, right, middle]


_SQUARE: Polygon = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
_DISC: Polygon = [(float(u), float(v)) for u, v in _arc(15, 345, CORNERS) / np.cos(np.pi / 12)]

# class -> extrusion axis and polygons in the two axes that follow it cyclically (z -> x, y; y -> z, x)
_SECTIONS: dict[str, tuple[int, list[Polygon]]] = {
    "cuboid": (2, [_SQUARE]),
    "cylinder": (1, [_DISC]),
    "half_cylinder": (1, [_half_disc()]),
    "triangular_prism": (2, [[(0.0, -0.5), (0.5, 0.5), (-0.5, 0.5)]]),
    "concave": (1, _notched()),
}


def _rings() -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vertices [C, P, 2K, 3] and the number of distinct corners [C, P] (0: no such part)."""
    vertices = np.zeros((len(CLASSES), CONVEX_PARTS, 2 * CORNERS, 3))
    used = np.zeros((len(CLASSES), CONVEX_PARTS), np.int32)
    for c, name in enumerate(CLASSES):
        axis, polygons = _SECTIONS[name]
        for p, polygon in enumerate(polygons):
            used[c, p] = len(polygon)
            ring = np.array(polygon + [polygon[-1]] * (CORNERS - len(polygon)))
            for side, at in enumerate((-0.5, 0.5)):
                block = vertices[c, p, side * CORNERS : (side + 1) * CORNERS]
                block[:, (axis + 1) % 3], block[:, (axis + 2) % 3], block[:, axis] = ring[:, 0], ring[:, 1], at
    return vertices, used


def _moments() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return volume [C], centre of mass [C, 3] and variance about it [C, 3] of the unit shapes."""
    volume = np.zeros(len(CLASSES))
    mean = np.zeros((len(CLASSES), 3))
    variance = np.zeros((len(CLASSES), 3))
    for c, name in enumerate(CLASSES):
        axis, polygons = _SECTIONS[name]
        first, second, area = np.zeros(2), np.zeros(2), 0.0
        for polygon in polygons:
            a = np.array(polygon)
            b = np.roll(a, -1, axis=0)
            cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
            area += cross.sum() / 2
            first += (cross[:, None] * (a + b)).sum(0) / 6
            second += (cross[:, None] * (a * a + a * b + b * b)).sum(0) / 12
        section = [(axis + 1) % 3, (axis + 2) % 3]
        volume[c] = area
        mean[c, section] = first / area
        variance[c, section] = second / area - (first / area) ** 2
        variance[c, axis] = 1 / 12
    return volume, mean, variance


_MOMENTS = _moments()
UNIT_VOLUME = _MOMENTS[0]
"""Volume of shapes of size 1: [C]."""
UNIT_CENTER_OF_MASS = _MOMENTS[1]
"""Centre of mass of shapes of size 1, from the middle of the bounding box: [C, 3]."""
UNIT_VARIANCE = _MOMENTS[2]
"""Variance of shapes of size 1 about their centre of mass: [C, 3]."""
_RINGS = _rings()
CORNERS_USED = _RINGS[1]
"""Number of distinct corners of the section of every part: [C, P]; 0 where there is no such part."""
UNIT_VERTICES = _RINGS[0] - UNIT_CENTER_OF_MASS[:, None, None] * (CORNERS_USED > 0)[..., None, None]
"""Corners of every part, from the centre of mass, of shapes of size 1: [C, P, 2K, 3]."""
AXIS = np.array([_SECTIONS[name][0] for name in CLASSES], np.int32)
"""Extrusion axis of each class: 0, 1, 2 for x, y, z."""


def _sides() -> np.ndarray:
    """Return for each ring edge [C, P, K] the first ring edge in the same plane: itself, or 0 for a repeated corner."""
    side = np.tile(np.arange(CORNERS), (len(CLASSES), CONVEX_PARTS, 1))
    repeated = (side >= CORNERS_USED[..., None] - 1) & (side < CORNERS - 1)
    return np.where(repeated, 0, side)


SIDES = _sides()
"""For each ring edge [C, P, K] the first ring edge in the same plane: itself, or 0 for a repeated corner."""


@dataclasses.dataclass(frozen=True)
class Item:
    """A named object of the catalogue: its class and nominal bounding box in millimetres."""

    name: str
    shape: str
    size_mm: tuple[float, float, float]


CATALOGUE = (
    Item("triangle", "triangular_prism", (100, 50, 50)),
    Item("concave", "concave", (50, 50, 100)),
    Item("cuboid_half", "cuboid", (50, 50, 25)),
    Item("cuboid_flat", "cuboid", (100, 50, 25)),
    Item("cuboid_long", "cuboid", (100, 50, 50)),
    Item("cube", "cuboid", (50, 50, 50)),
    Item("half_cylinder", "half_cylinder", (50, 40, 25)),
    Item("cylinder", "cylinder", (48, 50, 48)),
    Item("cylinder_flat", "cylinder", (66, 28, 56)),
    Item("half_cylinder_large", "half_cylinder", (83, 49, 30)),
    Item("concave_slim", "concave", (31, 28, 75)),
    Item("cuboid_mid", "cuboid", (67, 45, 30)),
    Item("cuboid_square", "cuboid", (70, 70, 25)),
    Item("triangle_flat", "triangular_prism", (66, 56, 30)),
)
"""All objects: the evaluation objects of DIPN's released code, then its further training objects."""

COLORS_RGB = (
    (78, 121, 167),
    (89, 161, 79),
    (156, 117, 95),
    (242, 142, 43),
    (237, 201, 72),
    (186, 176, 172),
    (255, 87, 89),
    (176, 122, 161),
    (118, 183, 178),
    (255, 157, 167),
)
"""The palette of object colours. Source: DIPN's released code."""

MAX_DIAGONAL = 0.126
"""Longest diagonal of a bounding box in metres: such an object fits a window of 64 pixels in any pose."""


@flax.struct.dataclass
class Hull(Pytree):
    """The convex parts of one object, in the object's own frame; V is 2 CORNERS, F is CORNERS + 2."""

    vertices: Float[Array, "*b P V 3"]  # metres: lower ring, upper ring, counter-clockwise about the axis
    normals: Float[Array, "*b P F 3"]  # outward unit normals: sides, lower cap, upper cap
    offsets: Float[Array, "*b P F"]  # metres: a point x is inside where normals @ x <= offsets
    alive: Bool[Array, "*b P"]  # whether there is such a part


def hull(shape: Int[Array, ""] | int, size: Float[Array, " 3"]) -> Hull:
    """Return the convex parts of an object.

    Args:
      shape: index into CLASSES; a negative one gives no part.
      size: metres, bounding box.
    """
    index = jnp.maximum(shape, 0)
    vertices = jnp.asarray(UNIT_VERTICES, jnp.float32)[index] * size
    axis = jnp.asarray(np.eye(3)[AXIS], jnp.float32)[index]
    ring = vertices[:, :CORNERS]
    edge = jnp.roll(ring, -1, axis=1) - ring
    normal = jnp.cross(edge, axis)
    square = (normal**2).sum(-1, keepdims=True)
    normal = normal / jnp.sqrt(jnp.where(square > 0, square, 1.0))  # of no length where corners are doubled
    sides = jnp.asarray(SIDES)[index]
    normal = jnp.take_along_axis(normal, sides[..., None], axis=1)
    corner = jnp.take_along_axis(ring, sides[..., None], axis=1)
    caps = jnp.broadcast_to(jnp.stack([-axis, axis]), (CONVEX_PARTS, 2, 3))
    cap_corner = jnp.stack([vertices[:, 0], vertices[:, CORNERS]], axis=1)
    normals = jnp.concatenate([normal, caps], axis=1)
    offsets = (normals * jnp.concatenate([corner, cap_corner], axis=1)).sum(-1)
    alive = (jnp.asarray(CORNERS_USED)[index] > 0) & (shape >= 0)
    return Hull(vertices, normals, offsets, alive)


def volume(shape: Int[Array, "*b"], size: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Return the volume in cubic metres of shapes with bounding boxes of `size` metres."""
    return UNIT_VOLUME[np.maximum(shape, 0)] * np.prod(size, axis=-1)


def inertia(
    shape: Int[Array, ""] | int, size: Float[Array, " 3"], mass: Float[Array, ""] | float
) -> Float[Array, " 3"]:
    """Return the diagonal inertia (kg m^2) about the centre of mass.

    Every class has two planes of symmetry, so its inertia is diagonal in its own axes.
    """
    spread = jnp.asarray(UNIT_VARIANCE, jnp.float32)[jnp.maximum(shape, 0)] * size**2
    return mass * (spread.sum() - spread)


def radius(shape: Int[Array, "*b"], size: Float[Array, "*b 3"]) -> Float[jax.Array, "*b"]:
    """Return the radius (metres) of a ball about the centre of mass that contains the object."""
    offset = jnp.asarray(UNIT_CENTER_OF_MASS, jnp.float32)[jnp.maximum(shape, 0)] * size
    return jnp.linalg.norm(size, axis=-1) / 2 + jnp.linalg.norm(offset, axis=-1)


def lowest_corner(
    shape: Int[Array, "*b"], size: Float[Array, "*b 3"], poses: Float[Array, "*b 7"], *, xp: Any = jnp
) -> Float[Array, "*b"]:
    """Return the height (metres) of the lowest corner of objects.

    `xp` is `jax.numpy`, or `numpy` where the number of objects changes from call to call.
    """
    w, x, y, z = (poses[..., 3 + i] for i in range(4))
    up = xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1)
    corners = xp.asarray(UNIT_VERTICES.reshape(len(CLASSES), -1, 3))[xp.maximum(shape, 0)]
    # a missing part's corners are at the centre of mass, never the lowest
    return poses[..., 2] + (corners * (size * up)[..., None, :]).sum(-1).min(-1)
