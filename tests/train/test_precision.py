"""Half precision reaches the layers of every network."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from dipn_jax.train import precision
from flax import nnx

from dipn_jax.networks.dipn import DIPN, DipnConfig
from dipn_jax.networks.grasp import GraspConfig, GraspNet
from dipn_jax.networks.push_frame import OUTLINE_DIRECTIONS, PushInput, View
from dipn_jax.networks.vpg import VPG, VpgConfig

SHALLOW = (1, 1, 1, 1)
"""Blocks of the stages of published trunks: one of each kind is enough."""


def _products(program: Any) -> Iterator[set[str]]:
    """Yield the types of the operands of all matrix products and convolutions of a traced program."""
    for equation in program.eqns:
        if equation.primitive.name in ("dot_general", "conv_general_dilated"):
            yield {str(operand.aval.dtype) for operand in equation.invars}
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda leaf: hasattr(leaf, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from _products(inner)


def _pushes(view: View) -> tuple[PushInput, jax.Array]:
    """Return the inputs of two pushes of three objects, and their distances."""
    maps = jnp.zeros((2, 0, 0) if view.context else (2, 64, 64))
    crops = jnp.zeros((2, 3, view.crop_side, view.crop_side, view.channels))
    outlines = jnp.zeros((2, 3, OUTLINE_DIRECTIONS if view.context else 0, 2))
    inputs = PushInput(maps, maps, crops, outlines, jnp.zeros((2, 3, 2)), jnp.ones((2, 3), bool))
    return inputs, jnp.full((2, 1), 0.1)


@pytest.mark.parametrize(
    ("network", "config", "others"),
    [
        (DIPN, DipnConfig(), 21),  # outlines that are turned and projected, and motions read at a distance
        (DIPN, DipnConfig("paper", stages=SHALLOW), 0),
        (GraspNet, GraspConfig(), 0),
        (GraspNet, GraspConfig("paper", stages=SHALLOW), 0),
        (VPG, VpgConfig(), 0),
        (VPG, VpgConfig("paper", blocks=SHALLOW), 4),  # images that are enlarged, and the map that is reduced
    ],
)
def test_all_products_of_layers_are_in_half_precision(network: Any, config: Any, others: int) -> None:
    graph, state = nnx.split(nnx.eval_shape(lambda: network(config, rngs=nnx.Rngs(0))))

    def forward(state: Any, *inputs: Any) -> Any:
        model = nnx.merge(graph, state, copy=True)
        model.train()
        precision.compute_in(model, "bfloat16")
        return (model.push if network is VPG else model)(*inputs)

    inputs = _pushes(config.view) if network is DIPN else (jnp.zeros((2, 64, 64, 4)),)
    traced = jax.make_jaxpr(forward)(state, *inputs)
    found = list(_products(traced.jaxpr))
    assert sum(types != {"bfloat16"} for types in found) == others and len(found) > others
    assert traced.out_avals[0].dtype == jnp.float32
