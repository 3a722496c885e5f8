"""The fast scores of imagined images, compared with those of whole images."""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import structs
from dipn_jax.networks import partial_scoring
from dipn_jax.planning import planner, predictors, scorers
from dipn_jax.sight import render
from dipn_jax.storage import checkpoint
from dipn_jax.structs import Decision, Observation

COUNT = 32


@pytest.fixture(scope="module")
def scores() -> dict[str, Any]:
    builtin = pathlib.Path("builtin")
    gn: Any = checkpoint.load_network(builtin, network="grasp")
    predictor = predictors.load_predictor(builtin)
    scorer = scorers.unaided_scorer(gn)
    fast = scorers.grasp_summary(gn)

    def decide(seen: Observation, quick: bool) -> Decision:
        rule = planner.Rule(grasp_above=1.0)
        return planner.decide(
            jax.random.key(0), seen, predictor, scorer, count=COUNT, rule=rule, summarize=fast if quick else None
        )

    return {"decide": decide, "gn": gn}


@pytest.mark.slow
def test_finalists_have_the_values_of_whole_images_and_the_same_one_wins(settled: Any, scores: dict[str, Any]) -> None:
    seen = render.observe(settled.scene, settled.poses)
    many = 0
    for i in range(6):
        table = structs.take(seen, i)
        plain, fast = (jax.device_get(scores["decide"](table, quick)) for quick in (False, True))
        many += plain.candidates.feasible.sum() > partial_scoring.SCORED_WHOLE
        np.testing.assert_array_equal(plain.candidates.feasible, fast.candidates.feasible)
        assert plain.best == fast.best and plain.is_push == fast.is_push
        equal = np.isclose(plain.values, fast.values, rtol=1e-4) & plain.candidates.feasible
        assert equal.sum() >= min(partial_scoring.FINALISTS, plain.candidates.feasible.sum())
    assert many, "every image was scored whole"


@pytest.mark.slow
def test_rough_means_rank_nearly_as_whole_images_do(settled: Any, scores: dict[str, Any]) -> None:
    seen = render.observe(settled.scene, settled.poses)
    image = np.asarray(jax.vmap(planner.render.rgbd)(seen))
    now = image[0]
    others = np.repeat(now[None], 8, 0)
    for k in range(8):  # a block of one colour and height at different places
        others[k, 20 + 20 * k : 45 + 20 * k, 30:80] = [0.5, 0.2, 0.2, 0.04]
    whole, _ = planner.summarize_whole(scorers.unaided_scorer(scores["gn"]))(now, others, np.ones(8, bool))
    whole = whole[1:]
    before = jax.jit(lambda image: partial_scoring.scores_now(scores["gn"], image))(now)

    def roughly(images: Any) -> Any:
        every = np.ones(8, bool)
        look = lambda turns: partial_scoring.rough_means(scores["gn"], now, before, images, every, turns=turns)  # noqa: E731
        return np.asarray(jax.jit(lambda: jnp.stack([look(turns) for turns in partial_scoring.PASS_TURNS]))())

    rough = roughly(others)
    change = np.asarray(whole) - np.asarray(whole).min()
    assert np.corrcoef(change, 2 * rough[0])[0, 1] > 0.9
    assert np.corrcoef(change, rough.sum(0))[0, 1] > 0.95
    np.testing.assert_array_equal(roughly(np.stack([now] * 8)), 0)
