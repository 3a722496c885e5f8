"""The engine as predictor guesses masses and frictions, and a simulation that went wrong is no candidate."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.eval.clearing import rollouts

from dipn_jax import structs
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Rule
from dipn_jax.sight import render
from dipn_jax.structs import Array, Decision, Fault, Rollout, Scene, SettledScene, Trajectory
from dipn_jax.world import shapes

SHIFT = 0.02
"""Metres by which the engine moves every object of friction 1 along x; others in proportion."""
PUSH_ALWAYS = Rule(gamma=2.0, grasp_above=2.0)


def half(images: jax.Array) -> jax.Array:
    """Give every grasp the score 1/2: a Scorer."""
    return jnp.full((images.shape[0], 16, *images.shape[1:3]), 0.5)


_summarize = planner.summarize_whole(half)


class Records:
    """An engine that keeps the scenes that it was given, in which some simulations go wrong."""

    name, batch = "records", 4

    def __init__(self, fault: int = 0) -> None:
        self.fault, self.seen = fault, []  # type: ignore[var-annotated]

    def simulate(self, scene: Scene, poses: Array, _: Trajectory, samples: Array, **__: Any) -> Rollout:
        """Return poses after the push in all samples; scenes whose first object is black have the fault."""
        self.seen.append(scene)
        out = np.repeat(np.asarray(poses)[:, None], len(samples), 1)
        out[:, 1:, :, 0] += SHIFT * np.asarray(scene.friction)[:, None]
        fault = np.where((np.asarray(scene.color)[:, 0] == 0).all(-1), self.fault, 0)
        return Rollout(out, np.zeros((*out.shape[:2], 5), np.float32), fault.astype(np.int32))


@pytest.fixture
def tables(settled: SettledScene) -> SettledScene:
    """Return three tables of unusual masses and frictions; the second has a black object."""
    some = structs.take(settled, np.array([0, 2, 3]))
    color = some.scene.color.copy()
    color[1, 0] = 0
    scene = some.scene.replace(color=color, mass=some.scene.mass + 10, friction=some.scene.friction + 5)
    return some.replace(scene=scene)


def _decide(tables: SettledScene, engine: Records) -> Decision:
    decision, seen = rollouts.decide_by_simulation(
        jax.random.split(jax.random.key(0), 3),
        tables.scene,
        tables.poses,
        lambda heights: np.repeat(planner.NONE_MISSED[None], len(heights), 0),
        scorer=half,
        summarize=_summarize,
        engine=engine,  # type: ignore[arg-type]
        rule=PUSH_ALWAYS,
        distances=np.full(3, 0.1, np.float32),
    )
    np.testing.assert_array_equal(seen.label, render.observe(tables.scene, tables.poses).label)
    return decision


@pytest.mark.slow
def test_the_engine_is_not_told_masses_and_frictions(tables: SettledScene) -> None:
    engine = Records()
    decision = _decide(tables, engine)
    asked = structs.concatenate(engine.seen)
    assert len(asked.shape) > Records.batch
    np.testing.assert_array_equal(asked.friction, np.float32(0.35))
    np.testing.assert_allclose(asked.mass, 500 * shapes.volume(asked.shape, asked.size), rtol=1e-5)
    assert asked.mass.max() < 1 and {tuple(row) for row in asked.shape} == {tuple(row) for row in tables.scene.shape}
    assert decision.is_push.all()
    np.testing.assert_allclose(decision.motion[..., 0], SHIFT * 0.35, atol=1e-6)
    np.testing.assert_allclose(decision.motion[..., 1:], 0, atol=1e-6)


@pytest.mark.parametrize("fault", [Fault.NON_FINITE, Fault.CAPACITY, Fault.SPEED, Fault.PENETRATION])
def test_a_push_whose_simulation_went_wrong_is_not_chosen(tables: SettledScene, fault: Fault) -> None:
    decision = _decide(tables, Records(fault))
    assert decision.is_push.tolist() == [True, False, True]
    assert np.isneginf(decision.value_push).tolist() == [False, True, False]


def test_a_push_that_moves_an_object_far_is_a_candidate(tables: SettledScene) -> None:
    assert _decide(tables, Records(Fault.OUTSIDE | Fault.UNSETTLED | Fault.TIPPED)).is_push.all()
