"""The kernel of a control period with other settings of the solver, and with more of everything than it has lanes."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from eventful import CLASS, SLOTS, scenes_with_control

from dipn_jax import physics
from dipn_jax.physics import mjx, patches, tick
from dipn_jax.physics.mjx_program import Program
from dipn_jax.physics.recording import State
from dipn_jax.structs import Scene

pytestmark = pytest.mark.slow
OTHER = dataclasses.replace(mjx.DEFAULTS, timestep=0.005, solref="-2000 -100", solimp="0.9 0.99 0.002 0.4 3")
"""Settings that change every number of a contact's rule."""
FALLEN = 20
"""Control periods after which all recorded scenes have contacts."""
GRID = (4, 3)
"""Boxes on the table along x and y, side by side."""


def _program(config: Any, solver: str, *, slots: int = SLOTS) -> Program:
    return Program(dataclasses.replace(config, solver=solver), slots, physics.substeps(config))


def test_each_engine_of_a_process_has_the_kernel_of_its_own_settings() -> None:
    patches.register()
    first, other = (_program(config, "warp") for config in (mjx.DEFAULTS, OTHER))
    assert first.kernel is not None and other.kernel is not None
    modules = {tick.load().kernel(8, 80, each.kernel.numbers).module.name for each in (first, other)}
    assert len(modules) == 2
    scene, poses, control = scenes_with_control()
    push = np.zeros((len(poses), 6 + 6 * SLOTS), np.float32)
    advance = {each: jax.jit(jax.vmap(each._tick)) for each in (first, other)}
    fields, state = jax.jit(jax.vmap(first._fields))(scene), jax.vmap(first._initial)(poses, control[0])
    for period in range(FALLEN):
        state = advance[first](fields, state, control[period], push)
    given = fields, state, control[FALLEN], push
    found = {each: advance[each](*given) for each in (first, other)}
    jax.tree.map(np.testing.assert_array_equal, advance[first](*given), found[first])
    for each, config in ((first, mjx.DEFAULTS), (other, OTHER)):
        program, wanted = _program(config, "xla"), state
        step = jax.jit(jax.vmap(lambda f, s, c, p, of=program: of._substep(of.base.tree_replace(f), c, p, s)))
        with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
            for _ in range(program.substeps):
                wanted = step(fields, wanted, control[FALLEN], push)
        apart = np.abs(found[each].qvel - wanted.qvel).max(-1)
        assert apart.max() < 0.01 and np.median(apart) < 1e-5, apart
    assert np.median(np.abs(found[first].qvel - found[other].qvel).max(-1)) > 1e-3, "the settings matter"


def test_more_of_everything_than_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks, contacts and pairs that one lane takes after another are those that a single lane takes."""
    import tick_kernels
    import warp

    slots, side = GRID[0] * GRID[1], 0.04
    program = _program(mjx.DEFAULTS, "warp", slots=slots)
    assert program.kernel is not None
    size, flat = np.full((slots, 3), side, np.float32), np.full(slots, 0.35, np.float32)
    scene = Scene(np.full(slots, CLASS["cuboid"], np.int32), size, size, np.full(slots, 0.05, np.float32), flat)
    x, y = np.indices(GRID).reshape(2, -1)
    place = np.stack([(side + 0.002) * x, (side - 1e-4) * y + 0.002 * (y > 1)], 1)  # the first two of a row touch
    poses = np.concatenate([place, np.full((slots, 1), side / 2 - 1e-4), np.tile([1.0, 0, 0, 0], (slots, 1))], 1)
    control = np.float32([0.3, 0, 0.3, 0, 0.03, 0.03])
    state: State = program._initial(jnp.asarray(poses, jnp.float32), jnp.asarray(control))
    leaves = tick.scene_fields(program._fields(jax.tree.map(jnp.asarray, scene)))
    leaves |= {"qpos": state.qpos, "qvel": state.qvel, "warmstart": state.warmstart, "control": control}
    given = {name: np.asarray(leaf)[None] for name, leaf in (leaves | {"push": 0 * state.qvel}).items()}
    seen = tick_kernels.look(program.kernel.numbers, given)
    assert 32 < (seen["stiffness"] > 0).sum() < tick_kernels.MOST and given["radius"].size > 32
    monkeypatch.setattr(warp.config, "enable_cpu_blocks", True)
    alone, together = (
        tick_kernels.advance(program.kernel.numbers, given, substeps=program.substeps, lanes=lanes) for lanes in (1, 32)
    )
    assert np.abs(alone["qvel"]).max() > 1e-3, "they move"
    np.testing.assert_allclose(together["qpos"], alone["qpos"], atol=1e-6)
    np.testing.assert_allclose(together["qvel"], alone["qvel"], atol=1e-4)
    np.testing.assert_array_equal(together["full"], alone["full"])
