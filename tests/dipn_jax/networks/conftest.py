"""Fixtures for the tests of networks."""

from typing import Any

import jax
import optax
import pytest
from flax import nnx


@pytest.fixture
def one_step() -> Any:
    """Return a function of model and loss that returns the loss before and after one step of gradient descent."""
    return _one_step


def _one_step(model: Any, loss: Any) -> tuple[float, float]:
    """Return the loss before and after one step of gradient descent."""
    optimizer = nnx.Optimizer(model, optax.sgd(1e-4), wrt=nnx.Param)

    @nnx.jit
    def step(m: Any, o: Any) -> jax.Array:
        value, gradient = nnx.value_and_grad(loss)(m)
        o.update(m, gradient)
        return value

    return float(step(model, optimizer)), float(step(model, optimizer))
