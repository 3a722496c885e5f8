"""A Warp kernel of the search for contacts alone (`narrow_*.h`), for tests: a warp of threads for a pair of geoms."""

import functools
import typing
from typing import Any

import numpy as np
import warp as wp
from solver_kernel import here

from dipn_jax.physics import colliders, cpp

LANES = 32
"""Threads that share a pair of geoms: a warp."""


def contacts(
    vertices: np.ndarray,
    normals: np.ndarray,
    radius: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    pairs: np.ndarray,
    *,
    planes: bool = False,
    lanes: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the contacts of pairs of prisms, or of planes and prisms, launched with that many lanes on the CPU.

    Args:
      vertices: `[G, 24, 3]` metres, in each geom's own frame, in the order of `prisms.parts`.
      normals: `[G, 14, 3]` of their faces.
      radius: `[G]` metres: ball about the origin of that frame; negative where the geom touches nothing.
      position: `[G, 3]` metres, world.
      rotation: `[G, 3, 3]` from the geom's frame to the world's.
      pairs: `[Q, 2]` the geoms of each pair.
      planes: whether the first of each pair is a plane; then nothing but its place matters.
      lanes: threads that share a pair.

    Returns:
      Distances `[Q, 4]` (metres; `colliders.APART_DISTANCE` where there is no contact), positions `[Q, 4, 3]` (zero
      where there is no contact) and frames `[Q, 4, 3, 3]`, world; the x axis points from the first to the second.
    """
    count, each = len(pairs), colliders.CONTACTS_PER_PAIR
    leaves = [np.asarray(leaf, np.float32) for leaf in (vertices, normals, radius, position, rotation)]
    inputs = [wp.array(leaf.ravel(), dtype=float) for leaf in leaves]
    inputs += [wp.array(np.asarray(pairs, np.int32).ravel(), dtype=wp.int32), len(vertices), count, int(planes)]
    out = [wp.zeros(each * size * count, dtype=float) for size in (1, 3, 9)]
    wp.launch(kernel(), dim=(count, LANES), inputs=[*inputs, *out], block_dim=lanes, device="cpu")
    distance, where, frame = (leaf.numpy() for leaf in out)
    return distance.reshape(count, each), where.reshape(count, each, 3), frame.reshape(count, each, 3, 3)


@functools.cache
def kernel() -> Any:
    """Return the kernel, which is launched with `LANES` threads a pair and blocks of that size.

    Arrays are flat, scene after scene; see `contacts`.
    """
    floats: Any
    integers: Any
    floats, integers = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32)

    @wp.func_native(cpp.source(cpp.NARROW, here("search_main.h"), room=cpp.NARROW_ROOM, numbers=cpp.NARROW_NUMBERS))
    @typing.no_type_check
    def collide_pair(
        vertex: floats, face_normal: floats, radius: floats, place: floats, rotation: floats, geom: integers,
        geoms: int, pairs: int, planes: int, distance: floats, position: floats, frame: floats, pair: int, lane: int,
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False, module_options={"block_dim": LANES})
    @typing.no_type_check
    def narrow(
        vertex: floats, face_normal: floats, radius: floats, place: floats, rotation: floats, geom: integers,
        geoms: int, pairs: int, planes: int, distance: floats, position: floats, frame: floats,
    ):  # fmt: skip
        pair, lane = wp.tid()
        collide_pair(
            vertex, face_normal, radius, place, rotation, geom, geoms, pairs, planes, distance, position, frame, pair,
            lane,
        )  # fmt: skip

    return narrow
