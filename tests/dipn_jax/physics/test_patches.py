"""MJX with our patches: models that are not ours step as they do without them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver, solver

from dipn_jax.errors import UserError
from dipn_jax.physics import colliders, cone, patches
from dipn_jax.physics.mjx import DEFAULTS, MjxEngine
from dipn_jax.physics.mjx_program import Program

FOREIGN = """<mujoco model="dipn_jax">
<option cone="elliptic" solver="Newton" jacobian="dense" timestep="0.004" iterations="20" ls_iterations="20"/>
<custom><numeric name="another_number" data="1"/></custom>
<asset>
 <mesh name="wedge" vertex="-.03 -.03 -.02  .03 -.03 -.02  .03 .03 -.02  -.03 .03 -.02  -.03 0 .02  .03 0 .02"/>
</asset>
<worldbody>
 <geom type="plane" size="0 0 1"/><geom type="box" size=".05 .05 .01" pos="0 0 .01"/>
 <body pos="0 0 .039"><freejoint/><geom type="mesh" mesh="wedge"/></body>
 <body pos=".012 .004 .078" euler="3 10 20"><freejoint/><geom type="mesh" mesh="wedge"/></body>
</worldbody></mujoco>"""
"""Two wedges of a mesh, one on the other, on a box: a model with every patched collider and an elliptic cone."""


@pytest.fixture
def unpatched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undo the patches of MJX for one test; an engine of another test may have made them."""
    monkeypatch.setattr(solver, "solve", getattr(solver.solve, "upstream", solver.solve))
    table = collision_driver._COLLISION_FUNC
    for types in patches._PATCHED_PAIRS:
        monkeypatch.setitem(table, types, getattr(table[types], "upstream", table[types]))


def _program() -> str:
    """Return the program of a step of the foreign model, newly traced."""
    m = mjx.put_model(mujoco.MjModel.from_xml_string(FOREIGN), impl="jax")
    with jax.numpy_rank_promotion("allow"):
        return jax.jit(lambda d: mjx.step(m, d)).lower(mjx.make_data(m)).as_text()


@pytest.mark.usefixtures("unpatched")
def test_a_foreign_model_steps_as_if_there_were_no_engine() -> None:
    untouched = solver.solve
    before = _program()
    MjxEngine()
    assert solver.solve is not untouched
    assert _program() == before


@pytest.mark.usefixtures("unpatched")
def test_our_models_use_our_solver_and_colliders(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def noting(module: Any, name: str) -> None:
        own = getattr(module, name)

        def called(*args: Any) -> Any:
            calls.append(name)
            return own(*args)

        monkeypatch.setattr(module, name, called)

    noting(cone, "solve")
    noting(colliders, "collide")
    patches.register()
    program = Program(DEFAULTS, 2, substeps=1)
    assert patches.is_ours(program.base)

    def collided_and_solved() -> Any:
        hulls = jax.tree.map(lambda leaf: jnp.stack([leaf] * program.base.ngeom), program.base._impl.mesh_convex[0])
        m = program.base.tree_replace({"_impl.mesh_convex": (hulls,)})
        return mjx.step(m, program.data)

    with jax.numpy_rank_promotion("allow"):
        jax.eval_shape(collided_and_solved)
    assert calls.count("solve") == 1
    kinds = {key.types for key in collision_driver._geom_groups(program.base)}
    assert calls.count("collide") >= len(kinds) == 3


@pytest.mark.usefixtures("unpatched")
def test_a_second_registration_changes_nothing() -> None:
    patches.register()
    once = solver.solve, dict(collision_driver._COLLISION_FUNC)
    patches.register()
    assert (solver.solve, collision_driver._COLLISION_FUNC) == once


def test_an_mjx_with_another_number_of_contacts_is_refused() -> None:
    def collide(*_: Any) -> Any: ...

    collide.ncon = 8  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="8 contacts for a pair"):
        patches._collider(collide)
