"""Kernels of a control period for tests: what the solver is given, and the period with any number of lanes."""

import functools
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from eventful import MOST
from solver_kernel import here

from dipn_jax.physics import tick, tick_kernel


def _inputs(state: Mapping[str, np.ndarray]) -> list[Any]:
    """Return the kernels' first arguments of scenes with their states, by the names of `tick_kernel.kernel`."""
    names = (*tick.FIELDS, "control", "push", "qpos", "qvel", "warmstart")
    return [wp.array(np.asarray(state[name], np.float32).ravel(), dtype=float) for name in names]


def advance(
    numbers: tick_kernel.Numbers, state: Mapping[str, np.ndarray], *, substeps: int, lanes: int
) -> dict[str, np.ndarray]:
    """Return the states of scenes `[B, ...]` after a control period, launched with that many lanes on the CPU."""
    batch, dof = np.shape(state["qvel"])
    out = {name: wp.zeros(np.size(state[name]), dtype=float) for name in ("qpos", "qvel", "warmstart")}
    more: dict[str, Any] = {"full": wp.zeros(batch, dtype=wp.int32), "depth": wp.zeros(batch, dtype=float)}
    inputs = [*_inputs(state), dof // 6, MOST, substeps, 50, 50, *out.values(), *more.values()]
    kernel = tick_kernel.kernel(*tick.capacity(dof // 6 - 1, MOST), numbers)
    wp.launch(kernel, dim=(batch, tick_kernel.LANES), inputs=inputs, block_dim=lanes, device="cpu")
    return {name: leaf.numpy().reshape(batch, -1) for name, leaf in (out | more).items()}


def look(numbers: tick_kernel.Numbers, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return what the solver is given for scenes `[B, ...]`: contacts that do not touch have rows of zeros."""
    batch, dof = np.shape(state["qvel"])
    geoms = np.shape(state["radius"])[1]
    shapes = {
        "mass": (dof // 6, 6, 6), "force": (dof,), "free": (dof,), "place": (geoms, 3), "row": (tick_kernel.ROWS, 6),
        "goal": (tick_kernel.ROWS,), "weight": (tick_kernel.ROWS,), "cones": (MOST, 3, dof), "cone_goal": (MOST, 3),
        "stiffness": (MOST,), "mu": (MOST,),
    }  # fmt: skip
    out = {name: wp.zeros(batch * int(np.prod(shape)), dtype=float) for name, shape in shapes.items()}
    kernel = _look_kernel(*tick.capacity(dof // 6 - 1, MOST), numbers)
    inputs = [*_inputs(state), dof // 6, MOST, *out.values()]
    wp.launch(kernel, dim=(batch, tick_kernel.LANES), inputs=inputs, block_dim=1, device="cpu")
    return {name: out[name].numpy().reshape(batch, *shape) for name, shape in shapes.items()}


@functools.cache
def _look_kernel(blocks: int, contacts: int, numbers: tick_kernel.Numbers) -> Any:
    """Return the kernel of `look`."""
    floats: Any = wp.array(dtype=wp.float32)

    @wp.func_native(tick_kernel.source(blocks, contacts, numbers, here("look_main.h")))
    @typing.no_type_check
    def look_at_scene(
        vertex: floats, face_normal: floats, radius: floats, center: floats, body_mass: floats, inertia: floats,
        friction: floats, control: floats, push: floats, qpos: floats, qvel: floats, warmstart: floats, blocks: int,
        most: int, mass: floats, force: floats, free: floats, place: floats, row: floats, goal: floats, weight: floats,
        cones: floats, cone_goal: floats, stiffness: floats, mu: floats, scene: int, lane: int,
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False, module_options={"block_dim": tick_kernel.LANES})
    @typing.no_type_check
    def look_at(
        vertex: floats, face_normal: floats, radius: floats, center: floats, body_mass: floats, inertia: floats,
        friction: floats, control: floats, push: floats, qpos: floats, qvel: floats, warmstart: floats, blocks: int,
        most: int, mass: floats, force: floats, free: floats, place: floats, row: floats, goal: floats, weight: floats,
        cones: floats, cone_goal: floats, stiffness: floats, mu: floats,
    ):  # fmt: skip
        scene, lane = wp.tid()
        look_at_scene(
            vertex, face_normal, radius, center, body_mass, inertia, friction, control, push, qpos, qvel, warmstart,
            blocks, most, mass, force, free, place, row, goal, weight, cones, cone_goal, stiffness, mu, scene, lane,
        )  # fmt: skip

    return look_at
