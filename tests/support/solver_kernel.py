"""A Warp kernel of the contact solver alone (`blocks_*.h`), for tests: a warp of threads for a scene."""

import dataclasses
import functools
import pathlib
import typing
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from dipn_jax.physics import cpp

LANES = 32
"""Threads that share a scene: a warp."""
MOST_ROWS = 4
"""Equalities and limits that there is room for."""
ROOM = (8, 80)
"""Blocks and contacts of a scene that there is room for."""


@dataclasses.dataclass
class Problem:
    """The problem of `cone._Problem` in blocks: bodies of a tree are one block, and a contact moves two at most.

    The first three degrees of freedom of a block move its bodies along x, y and z.
    """

    mass: np.ndarray  # [B, 6, 6]
    force: np.ndarray  # [B*6]: mass @ free
    free: np.ndarray  # [B*6]: acceleration without constraints
    velocity: np.ndarray  # [B*6]
    center: np.ndarray  # [B, 3]: metres, world: what lever arms begin at
    axes: np.ndarray  # [B, 3, 6]: how the other three turn and shift a body at the centre, world
    row: np.ndarray  # [R, 6]: equalities, then limits, of the first block
    row_goal: np.ndarray  # [R]
    row_weight: np.ndarray  # [R]
    position: np.ndarray  # [C, 3]: metres, world: of contacts
    frame: np.ndarray  # [C, 3, 3]: rows: normal from the first body to the second, tangents
    side: np.ndarray  # [C, 2]: the two bodies: 8 block + a bit for each of the other three that move it; -1: table
    scale: np.ndarray  # [C, 3]: of the three rows of a contact; the first is the slope of the scaled cone
    stiffness: np.ndarray  # [C]: 0: no contact
    damping: np.ndarray  # [C]: 1/s: the goal is -damping * velocity
    bias: np.ndarray  # [C]: m/s^2: minus this along the normal
    equalities: int

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by name, in the order of the kernel's first arguments."""
        return {key: value for key, value in vars(self).items() if key != "equalities"}


def minimize(problems: Sequence[Problem], *, lanes: int = 1, iterations: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Return accelerations `[B, V]` and numbers of steps `[B]`, launched with that many lanes on the CPU."""
    leaves = [np.stack(each) for each in zip(*(p.arrays().values() for p in problems), strict=True)]
    arrays = [wp.array(leaf.ravel(), dtype=wp.int32 if leaf.dtype.kind == "i" else float) for leaf in leaves]
    start = wp.full(problems[0].free.size * len(problems), float("nan"), dtype=float)  # so it begins at `free`
    out, steps = wp.zeros_like(start), wp.zeros(len(problems), dtype=wp.int32)
    blocks, contacts, rows = (len(getattr(problems[0], name)) for name in ("mass", "position", "row"))
    numbers = [blocks, contacts, rows, problems[0].equalities, iterations, 50]
    inputs = [*arrays, start, *numbers, out, steps]
    wp.launch(kernel(), dim=(len(problems), LANES), inputs=inputs, block_dim=lanes, device="cpu")
    return out.numpy().reshape(len(problems), -1), steps.numpy()


def here(name: str) -> str:
    """Return the text of a file in this folder."""
    return pathlib.Path(__file__).with_name(name).read_text(encoding="utf-8")


@functools.cache
def kernel() -> Any:
    """Return the kernel, which is launched with `LANES` threads a scene and blocks of that size.

    Arrays are flat, scene after scene: those of `Problem`, then an acceleration to begin from where it costs less than
    `free`; out: `acceleration [blocks, 6]`, `steps` (of Newton's).
    """
    floats: Any
    integers: Any
    floats, integers = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32)

    room = {"BLOCKS": ROOM[0], "CONTACTS": ROOM[1], "ROWS": MOST_ROWS}

    @wp.func_native(cpp.source(cpp.SOLVER, here("solver_main.h"), room=room, numbers=cpp.SOLVER_NUMBERS))
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
