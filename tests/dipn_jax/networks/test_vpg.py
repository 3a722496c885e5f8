"""The networks of the compared methods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dipn_jax.errors import UserError
from dipn_jax.networks import vpg
from dipn_jax.networks.vpg import VpgConfig
from dipn_jax.planning import scorers
from dipn_jax.storage import checkpoint


def _parameters(model: nnx.Module) -> int:
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


@pytest.mark.slow
def test_a_trunk_is_densenet_121() -> None:
    trunk = nnx.eval_shape(lambda: vpg.DenseNet((6, 12, 24, 16), nnx.Rngs(0)))
    assert _parameters(trunk) == 6_953_856  # torchvision's densenet121 without its classifier
    out = nnx.eval_shape(lambda model: model(jnp.zeros((1, 64, 64, 3))), trunk)
    assert out.shape == (1, 2, 2, 1024) and trunk.features == 1024


def test_the_published_form_has_two_trunks_per_primitive_and_scores_every_pixel() -> None:
    blocks = (1, 1, 1, 1)  # tracing 121 layers four times takes a minute
    model = nnx.eval_shape(lambda: checkpoint.build("vpg", VpgConfig(preset="paper", blocks=blocks)))
    trunk = nnx.eval_shape(lambda: vpg.DenseNet(blocks, nnx.Rngs(0)))
    heads = 2 * (2 * 2 * trunk.features + 2 * trunk.features * 64 + 2 * 64 + 64)
    assert _parameters(model) == 4 * _parameters(trunk) + heads
    assert nnx.eval_shape(lambda m: m.push(jnp.zeros((1, 64, 64, 4))), model).shape == (1, 64, 64)


def test_pushes_have_sixteen_directions_and_grasps_eight() -> None:
    model = checkpoint.build("vpg", VpgConfig(width=8, coarse=8))
    model.eval()
    pushes, grasps = scorers.value_scorers(model)  # type: ignore[arg-type]
    image = jnp.zeros((1, 224, 224, 4)).at[:, 90:130, 60:120, 3].set(0.05)
    push, grasp = np.asarray(pushes(image))[0], np.asarray(grasps(image))[0]
    assert push.shape == grasp.shape == (16, 224, 224)
    np.testing.assert_array_equal(grasp[8:], grasp[:8])
    assert np.abs(push[8:] - push[:8]).max() > 1e-3
    on_table = np.asarray(image)[0, ..., 3] == 0
    assert (push[:, on_table] != 0).any(), "a push begins beside an object"
    assert np.isneginf(grasp[:, on_table]).all() and np.isfinite(grasp[:, ~on_table]).all(), "values may be negative"


def test_a_chance_on_empty_table_is_zero() -> None:
    model = checkpoint.build("vpg", VpgConfig(parts=("grasp",), answers="chance", width=8, coarse=8))
    model.eval()
    _, grasps = scorers.value_scorers(model)  # type: ignore[arg-type]
    image = jnp.zeros((1, 224, 224, 4)).at[:, 90:130, 60:120, 3].set(0.05)
    scores = np.asarray(grasps(image))[0]
    assert (scores[:, np.asarray(image)[0, ..., 3] == 0] == 0).all() and scores.max() > 0


def test_a_part_without_training_is_none_and_invalid_options_are_refused() -> None:
    model = checkpoint.build("vpg", VpgConfig(parts=("grasp",), answers="chance", width=8, coarse=8))
    pushes, grasps = scorers.value_scorers(model)  # type: ignore[arg-type]
    assert pushes is None and grasps is not None
    for wrong in ({"preset": "huge"}, {"parts": ("place",)}, {"answers": "maybe"}):
        with pytest.raises(UserError, match="VPG network"):
            VpgConfig(**wrong)  # type: ignore[arg-type]
