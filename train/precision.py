"""The precision that a network's layers compute in."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import nnx


def compute_in(model: nnx.Module, precision: str) -> None:
    """Make every layer of a network that has weights compute in a precision; the weights stay as they are.

    Args:
      model: the network; it is changed.
      precision: float32 leaves it alone; with bfloat16, layers round their inputs and weights to it and give their
        outputs in it. Statistics of batches, positions along a push, and the outputs of whole networks stay float32.
    """
    if precision == "float32":
        return
    for _, node in nnx.iter_graph(model):
        layer: Any = node
        if isinstance(node, nnx.Module) and hasattr(node, "param_dtype"):
            layer.dtype = jnp.bfloat16
