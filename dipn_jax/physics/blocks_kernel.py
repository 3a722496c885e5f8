"""The Warp kernel of `blocks`, made of C++ (`blocks_cost.h`, `blocks_newton.h`). Importing this imports Warp.

Warp reads annotations itself, so they are no strings here, and the shape checks of tests leave the functions alone.
"""

import functools
import pathlib
import typing
from typing import Any

import warp as wp

from dipn_jax.physics import cone

LANES = 32
"""Threads that share a scene: a warp."""
MOST_ROWS = 4
"""Equalities and limits that there is room for."""
_SOURCE_FILES = ("blocks_cost.h", "blocks_newton.h")


def _source(blocks: int, contacts: int) -> str:
    """Return the C++ of the solver with room for that many blocks and contacts."""
    numbers = {
        "TOLERANCE": cone.NEWTON_TOLERANCE,
        "FLAT": cone.FLAT_SLOPE,
        "NARROW": cone.NARROW_BRACKET,
        "FIRST": cone.FIRST_STEPS[0],
        "STRETCH": cone.STRETCH_LIMIT,
        "TINY": cone.TINY,
    }
    rooms = f"enum {{ BLOCKS = {blocks}, CONTACTS = {contacts}, ROWS = {MOST_ROWS} }};\n"
    lines = [f"constexpr float {name} = {float(value)!r}f;\n" for name, value in numbers.items()]
    here = pathlib.Path(__file__)
    return rooms + "".join(lines) + "".join(here.with_name(part).read_text(encoding="utf-8") for part in _SOURCE_FILES)


@functools.cache
def kernel(blocks: int, contacts: int) -> Any:
    """Return the kernel with room for that many blocks of six degrees of freedom and contacts of a scene.

    It is launched with `LANES` threads a scene and blocks of that size. Arrays are flat, scene after scene:

    - `mass [blocks, 6, 6]`, `force`, `free` and `velocity [blocks, 6]`: see `blocks.Problem`;
    - `center [blocks, 3]` and `axes [blocks, 3, 6]`;
    - `row [rows, 6]`, `row_goal` and `row_weight [rows]`, the first `equalities` of them two-sided;
    - `position [contacts, 3]`, `frame [contacts, 3, 3]`, `side [contacts, 2]`, `scale [contacts, 3]`, `stiffness`,
      `damping` and `bias [contacts]`;
    - `start [blocks, 6]`: an acceleration to begin from, where it costs less than `free`;
    - out: `acceleration [blocks, 6]`, `steps` (of Newton's).
    """
    floats: Any
    integers: Any
    floats, integers = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32)

    @wp.func_native(_source(blocks, contacts))
    @typing.no_type_check
    def solve_scene(
        mass: floats, force: floats, free: floats, velocity: floats, center: floats, axes: floats, row: floats,
        row_goal: floats, row_weight: floats, position: floats, frame: floats, side: integers, scale: floats,
        stiffness: floats, damping: floats, bias: floats, start: floats, blocks: int, contacts: int, rows: int,
        equalities: int, iterations: int, limit: int, acceleration: floats, steps: integers, scene: int, lane: int,
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False, module_options={"block_dim": LANES})
    @typing.no_type_check
    def solve(
        mass: floats, force: floats, free: floats, velocity: floats, center: floats, axes: floats, row: floats,
        row_goal: floats, row_weight: floats, position: floats, frame: floats, side: integers, scale: floats,
        stiffness: floats, damping: floats, bias: floats, start: floats, blocks: int, contacts: int, rows: int,
        equalities: int, iterations: int, limit: int, acceleration: floats, steps: integers,
    ):  # fmt: skip
        scene, lane = wp.tid()
        solve_scene(
            mass, force, free, velocity, center, axes, row, row_goal, row_weight, position, frame, side, scale,
            stiffness, damping, bias, start, blocks, contacts, rows, equalities, iterations, limit, acceleration, steps,
            scene, lane,
        )  # fmt: skip

    return solve
