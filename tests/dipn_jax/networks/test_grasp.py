from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dipn_jax import geometry
from dipn_jax.networks import grasp, losses
from dipn_jax.sight import render
from dipn_jax.workspace import grasp_angles


def test_compact_grasp_scores_belong_to_their_own_pixel() -> None:
    # the score map of a turned image is the turned score map
    model = grasp.GraspNet(grasp.GraspConfig(), rngs=nnx.Rngs(0))
    model.eval()
    image = jnp.zeros((224, 224, 4)).at[100:130, 60:90, 3].set(0.05)
    scores = nnx.jit(grasp.score_image)(model, image)
    assert scores.shape == (16, 224, 224)
    assert (scores >= 0).all() and (scores <= 1).all()
    np.testing.assert_array_equal(scores[3], scores[11])
    quarter = nnx.jit(grasp.score_image)(model, jnp.rot90(image, k=-1, axes=(0, 1)))
    # rot90 by -1 takes +x (columns) to +y (rows): rotation k becomes k + 4
    want = jnp.rot90(scores[0], k=-1, axes=(0, 1))
    assert np.corrcoef(np.ravel(quarter[4]), np.ravel(want))[0, 1] > 0.95


def test_scores_by_tables_are_scores_of_turned_maps() -> None:
    model = grasp.GraspNet(grasp.GraspConfig(width=8, coarse=8, blocks=1), rngs=nnx.Rngs(0))
    model.eval()
    table = jnp.array([*render.TABLE_COLOR, 0.0])
    block = jnp.array([0.9, 0.1, 0.4, 0.05])
    image = jnp.broadcast_to(table, (224, 224, 4)).at[80:130, 60:90].set(block)
    half = jnp.asarray(grasp_angles())[:8]
    views = jax.vmap(lambda a: geometry.rotate_map(image - table, a, grasp.VIEW_PIXELS) + table)(half)
    plain = jax.vmap(lambda s, a: geometry.unrotate_map(s, a, 224))(nnx.sigmoid(model(views)), half)
    plain = plain.at[:, image[..., 3] == 0].set(0.0)  # no grasp is centred on empty table
    assert plain.max() > 0.1
    quick = np.asarray(nnx.jit(grasp.score_image)(model, image))
    assert (np.abs(quick[:8] - plain) < 1e-5).mean() > 0.999  # but for pixels at the border between two
    np.testing.assert_array_equal(quick[8:], quick[:8])


@pytest.mark.parametrize("preset", ["compact", pytest.param("paper", marks=pytest.mark.slow)])
def test_grasp_scores_are_deterministic_and_each_image_has_its_own(preset: str) -> None:
    model = grasp.GraspNet(grasp.GraspConfig(preset=preset, stages=(1, 1, 1, 1)), rngs=nnx.Rngs(0))
    model.eval()
    graph, state = nnx.split(model)
    answer = jax.jit(lambda images: nnx.merge(graph, state)(images))
    images = jax.random.uniform(jax.random.key(0), (2, 64, 64, 4))
    there = answer(images)
    np.testing.assert_array_equal(there, answer(images))
    np.testing.assert_allclose(answer(images.at[1].set(0.0))[0], there[0], atol=1e-5)


@pytest.mark.slow
def test_paper_grasp_net_takes_a_training_step(one_step: Any) -> None:
    model = grasp.GraspNet(grasp.GraspConfig(preset="paper", stages=(1, 1, 1, 1)), rngs=nnx.Rngs(0))
    images = jnp.zeros((1, 320, 320, 4)).at[:, 100:150, 100:200, 3].set(0.05)
    target = jnp.zeros((1, 320, 320)).at[:, 120, 150].set(1.0)
    model.eval()
    assert nnx.jit(lambda m, x: m(x))(model, images).shape == (1, 320, 320)
    model.train()
    before, after = one_step(model, lambda m: losses.score_loss(m(images), target, jnp.ones_like(target)))
    assert np.isfinite(before) and after < before
