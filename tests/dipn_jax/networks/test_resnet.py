"""Convolutions and pooling written for speed, compared with Flax's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dipn_jax.networks import resnet


@pytest.mark.parametrize(
    ("side", "size", "stride", "features"),
    [
        (6, 1, 1, (3, 5)),
        (7, 1, 2, (3, 5)),
        (4, 3, 1, (3, 5)),
        (2, 3, 1, (3, 5)),
        (4, 3, 2, (3, 5)),
        (8, 3, 2, (3, 5)),
        (7, 3, 2, (3, 5)),
        (9, 3, 1, (3, 5)),
        (9, (3, 7), 1, (1, 1)),
    ],
)
def test_convolution_and_its_gradients_are_those_of_flax(
    side: int, size: int | tuple[int, int], stride: int, features: tuple[int, int]
) -> None:
    rng = np.random.default_rng(0)
    layer = resnet.conv(*features, size, nnx.Rngs(0), stride=stride)
    layer.bias[...] = jnp.asarray(rng.normal(size=features[1]), jnp.float32)
    x = jnp.asarray(rng.normal(size=(2, side, side, features[0])), jnp.float32)
    graph, state = nnx.split(layer)

    def ours(state: nnx.State, x: jax.Array) -> jax.Array:
        return jnp.sin(nnx.merge(graph, state)(x)).sum()

    def theirs(state: nnx.State, x: jax.Array) -> jax.Array:
        return jnp.sin(nnx.Conv.__call__(nnx.merge(graph, state), x)).sum()

    assert layer(x).shape == nnx.Conv.__call__(layer, x).shape
    for mine, other in zip(
        jax.tree.leaves(jax.value_and_grad(ours, (0, 1))(state, x)),
        jax.tree.leaves(jax.value_and_grad(theirs, (0, 1))(state, x)),
        strict=True,
    ):
        np.testing.assert_allclose(mine, other, atol=2e-5)


@pytest.mark.parametrize("side", [6, 7])
def test_max_pool_is_flax(side: int) -> None:
    x = jnp.asarray(np.random.default_rng(1).normal(size=(2, side, side, 3)), jnp.float32)
    np.testing.assert_array_equal(resnet.max_pool(x), nnx.max_pool(x, (3, 3), (2, 2), ((1, 1), (1, 1))))
