"""What each aid does by itself, and that nothing is left of them without."""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dipn_jax.names import ALL_AIDS, Aid
from dipn_jax.networks import grasp
from dipn_jax.networks.vpg import VpgConfig
from dipn_jax.planning import methods, planner, predictors, scorers
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.sight import fingers
from dipn_jax.storage import checkpoint
from dipn_jax.structs import Observation, Push


@pytest.fixture(scope="module")
def image() -> Any:
    """Two blocks as far apart as the open fingers, one of them at the border, all mirrored."""
    height = jnp.zeros((224, 224)).at[60:90, 60:80].set(0.04).at[60:90, 86:100].set(0.09).at[150:180, :20].set(0.05)
    height = jnp.maximum(height, height[:, ::-1])
    return jnp.concatenate([jnp.full((224, 224, 3), 0.4), height[..., None]], -1)


@pytest.fixture(scope="module")
def network() -> grasp.GraspNet:
    model = grasp.GraspNet(grasp.GraspConfig(width=8, coarse=8, blocks=1), rngs=nnx.Rngs(0))
    model.eval()
    return model


@pytest.fixture(scope="module")
def scores(network: grasp.GraspNet, image: Any) -> Any:
    """The scores of the image with the aids that are named."""
    graph, state = nnx.split(network)

    def find(*aids: Aid) -> np.ndarray:
        return np.asarray(jax.jit(lambda x: grasp.aided_scores(nnx.merge(graph, state), x, aids=aids))(image))

    return find


def test_without_aids_the_scores_are_those_of_the_network(scores: Any, network: grasp.GraspNet, image: Any) -> None:
    plain = nnx.jit(lambda model, x: grasp.score_image(model, x, table=False))(network, image)
    np.testing.assert_array_equal(scores(), plain)
    assert (scores()[:, 10, 10] > 0).all(), "also of empty table"


def test_with_table_alone_only_empty_table_differs(scores: Any, image: Any) -> None:
    table = np.asarray(image[..., 3]) == 0
    with_table, bare = scores("table"), scores()
    assert (with_table[:, table] == 0).all()
    np.testing.assert_array_equal(with_table[:, ~table], bare[:, ~table])


def test_with_mirrors_alone_a_grasp_and_its_mirror_image_score_the_least_of_both(scores: Any) -> None:
    def mirrored(of: np.ndarray) -> np.ndarray:
        """Return the scores of mirrored grasps: the image is its own mirror image."""
        return of[-np.arange(16) % 16, :, ::-1]

    bare, found = scores(), scores("mirrors")
    assert np.abs(bare - mirrored(bare)).max() > 1e-3, "the network knows no symmetry"
    np.testing.assert_array_equal(found, mirrored(found))
    assert (found <= np.minimum(bare, mirrored(bare))).all()
    upside = scores("mirrors") < np.minimum(bare, mirrored(bare)) - 1e-6
    assert upside.any(), "the image upside down counts, too"


@pytest.mark.parametrize("aid", ["fingers", "border"])
def test_with_fingers_or_border_alone_blocked_grasps_score_half(scores: Any, image: Any, aid: Aid) -> None:
    which = {"inside": aid == "fingers", "beyond": aid == "border"}
    blocked = np.asarray(fingers.blocked_image(image[..., 3], **which)) > 0
    assert 0.001 < blocked.mean() < 0.5
    np.testing.assert_allclose(scores(aid), np.where(blocked, scores() / 2, scores()), rtol=1e-6)


def test_rules_follow_the_aids() -> None:
    bare = PolicyConfig(aids=()).rule()
    assert bool(bare.draw_all) and bare.top_margin == 0.0
    assert not PolicyConfig(aids=("still",)).rule().draw_all
    assert PolicyConfig(aids=("top",)).rule().top_margin == planner.TOP_MARGIN
    every = PolicyConfig().rule()
    assert not every.draw_all and every.top_margin == planner.TOP_MARGIN


def test_values_of_the_compared_methods_are_aided_by_the_same_names(image: Any) -> None:
    model = checkpoint.build("vpg", VpgConfig(width=8, coarse=8))
    model.eval()
    _, bare = scorers.value_scorers(model, aids=())  # type: ignore[arg-type]
    _, careful = scorers.value_scorers(model, aids=ALL_AIDS)  # type: ignore[arg-type]
    assert bare is not None and careful is not None
    plain, low = (np.asarray(jax.jit(each)(image[None]))[0] for each in (bare, careful))
    on = np.asarray(image[..., 3]) > 0
    assert np.isfinite(plain).all() and np.isneginf(low[:, ~on]).all()
    assert (low[:, on] <= plain[:, on]).all() and (low[:, on] < plain[:, on]).mean() > 0.5


@pytest.mark.slow
def test_dipn_predicts_once_without_mirrors() -> None:
    builtin = checkpoint.find(pathlib.Path("builtin"), network="dipn")
    label = jnp.full((224, 224), -1).at[100:130, 100:120].set(0).at[100:130, 125:140].set(1)
    seen = Observation(jnp.where(label >= 0, 0.04, 0.0), jnp.full((224, 224, 3), 0.5), label, slots=2)
    push = Push(jnp.array([[-0.06, 0.004]]), jnp.zeros(1), jnp.full(1, 0.08))
    once = predictors.load_predictor(builtin, mirrors=False)(seen, push)
    twice = predictors.load_predictor(builtin)(seen, push)
    assert 1e-5 < np.abs(once - twice).max() < 0.02
    flipped = Observation(seen.height[::-1], seen.color[::-1], label[::-1], slots=2)
    other = Push(push.start * jnp.array([1, -1]), push.angle, push.distance)
    again = predictors.load_predictor(builtin, mirrors=False)(flipped, other) * jnp.array([1, -1, -1])
    np.testing.assert_allclose(twice, (once + again) / 2, atol=2e-4)
    for aids, wanted in ((("mirrors",), twice), ((), once)):
        predict = methods._predictor({"push": builtin}, PolicyConfig(aids=aids))  # type: ignore[arg-type]
        np.testing.assert_allclose(predict(seen, push), wanted, atol=1e-6)
