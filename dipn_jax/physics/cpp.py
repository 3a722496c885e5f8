"""The C++ of kernels (`*.h` in this folder), and the numbers that Python puts in front of it."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence

from dipn_jax.physics import colliders, cone
from dipn_jax.world.shapes import CORNERS

CLIP_SLACK = 1e-6
"""What MJX takes for zero as it clips faces."""
NARROW = ("narrow_hulls.h", "narrow_faces.h", "narrow_edges.h", "narrow_pair.h")
"""Files of the search for contacts of a pair of geoms."""
SOLVER = ("blocks_cost.h", "blocks_newton.h")
"""Files of the contact solver."""
NARROW_NUMBERS = {
    "APART": colliders.APART_DISTANCE,
    "TOUCHING": colliders.TOUCHING_HEIGHT,
    "SAME": colliders.SAME_CONTACT_DISTANCE,
    "PREFERENCE": colliders.FACE_PREFERENCE,
    "PARALLEL": colliders.PARALLEL_SQUARED_SINE,
    "CLIP_SLACK": CLIP_SLACK,
}
"""Numbers of the search for contacts."""
NARROW_ROOM = {"RING": CORNERS, "EACH": colliders.CONTACTS_PER_PAIR}
"""Corners of a ring of a hull, and contacts of a pair of geoms."""
SOLVER_NUMBERS = {
    "TOLERANCE": cone.NEWTON_TOLERANCE,
    "FLAT": cone.FLAT_SLOPE,
    "NARROW": cone.NARROW_BRACKET,
    "FIRST": cone.FIRST_STEPS[0],
    "STRETCH": cone.STRETCH_LIMIT,
    "TINY": cone.TINY,
}
"""Numbers of the contact solver."""


def source(
    files: Sequence[str],
    main: str,
    *,
    room: Mapping[str, int],
    numbers: Mapping[str, float],
    lists: Mapping[str, Sequence[float]] | None = None,
) -> str:
    """Return the C++ of a function's body.

    Args:
      files: names of files in this folder, after `lanes.h`, on which all build.
      main: C++ that comes last.
      room: integers by name, which come first.
      numbers: numbers by name.
      lists: lists of numbers by the name of a macro.
    """
    rooms = ", ".join(f"{name} = {size}" for name, size in room.items())
    lines = [f"enum {{ {rooms} }};\n", *(f"constexpr float {name} = {_text(x)};\n" for name, x in numbers.items())]
    for name, values in (lists or {}).items():
        lines.append(f"#define {name} {{ {', '.join(map(_text, values))} }}\n")
    return "".join([*lines, *map(read, ("lanes.h", *files)), main])


def read(name: str) -> str:
    """Return the text of a file in this folder."""
    return pathlib.Path(__file__).with_name(name).read_text(encoding="utf-8")


def _text(value: float) -> str:
    return f"{float(value)!r}f"
