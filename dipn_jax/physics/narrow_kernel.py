"""The Warp kernel of `narrow`, made of C++ (`narrow_hulls.h` and the two after it). Importing this imports Warp.

Warp reads annotations itself, so they are no strings here, and the shape checks of tests leave the functions alone.
"""

import functools
import pathlib
import typing
from typing import Any

import warp as wp

from dipn_jax.physics import colliders
from dipn_jax.world.shapes import CORNERS

LANES = 32
"""Threads that share a pair of geoms: a warp."""
CLIP_SLACK = 1e-6
"""What MJX takes for zero as it clips faces."""
_SOURCE_FILES = ("narrow_hulls.h", "narrow_faces.h", "narrow_edges.h")


def _source() -> str:
    """Return the C++ of the search for contacts."""
    numbers = {
        "APART": colliders.APART_DISTANCE,
        "TOUCHING": colliders.TOUCHING_HEIGHT,
        "SAME": colliders.SAME_CONTACT_DISTANCE,
        "PREFERENCE": colliders.FACE_PREFERENCE,
        "PARALLEL": colliders.PARALLEL_SQUARED_SINE,
        "CLIP_SLACK": CLIP_SLACK,
    }
    rooms = f"enum {{ RING = {CORNERS}, CONTACTS = {colliders.CONTACTS_PER_PAIR} }};\n"
    lines = [f"constexpr float {name} = {float(value)!r}f;\n" for name, value in numbers.items()]
    here = pathlib.Path(__file__)
    return rooms + "".join(lines) + "".join(here.with_name(part).read_text(encoding="utf-8") for part in _SOURCE_FILES)


@functools.cache
def kernel() -> Any:
    """Return the kernel, which is launched with `LANES` threads a pair and blocks of that size.

    Arrays are flat, scene after scene; hulls are prisms as by `prisms.parts`:

    - `vertex [geoms, 24, 3]` and `face_normal [geoms, 14, 3]` in each geom's own frame;
    - `radius [geoms]` of a ball about the place of a geom; negative: it touches nothing;
    - `place [geoms, 3]` and `rotation [geoms, 3, 3]`, world;
    - `geom [pairs, 2]`, the first of a pair a plane where `planes` is 1;
    - out: `distance [pairs, 4]`, `position [pairs, 4, 3]` and `frame [pairs, 4, 3, 3]`, as `colliders.convex_prism`.
    """
    floats: Any
    integers: Any
    floats, integers = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32)

    @wp.func_native(_source())
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
