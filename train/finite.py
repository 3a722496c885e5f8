"""Notice losses and weights that are not finite, without waiting for the device, and report them in one line."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax.errors import UserError

NAMED_EXAMPLES = 32
"""Examples of a batch that a message names at most."""


@jax.jit
def _earliest(first: jax.Array, loss: jax.Array, step: int) -> jax.Array:
    """Return the first step whose loss was not finite; -1 if there is none."""
    return jnp.where((first < 0) & ~jnp.isfinite(loss), step, first)


@jax.jit
def all_finite(tree: Any) -> jax.Array:
    """Return whether all numbers of a pytree are finite; a bool on the device."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.array([jnp.isfinite(leaf).all() for leaf in leaves]).all()


class Watch:
    """Looks at the losses of steps on the device; the host asks only where it waits for the device anyway."""

    def __init__(self, rate: float, examples: Callable[[int], Sequence[int] | np.ndarray], kept: str) -> None:
        """Begin to watch.

        Args:
          rate: learning rate, for the message.
          examples: returns the examples of a step's batch.
          kept: says from what the run can continue, for the message.
        """
        self.rate, self.examples, self.kept = rate, examples, kept
        self._first = jnp.array(-1)

    def see(self, step: int, loss: jax.Array) -> None:
        """Look at the loss of step `step`, which counts from 0, without waiting for it."""
        self._first = _earliest(self._first, loss, step)

    def check(self, step: int, state: Any, **measured: float) -> None:
        """Check the losses so far, the state after `step` steps and what was measured; waits for the device.

        Raises:
          UserError: one of them is not finite.
        """
        first = int(self._first)
        if first >= 0:
            raise self._error(first, "the loss")
        if not bool(all_finite(state)):
            raise self._error(step - 1, "a weight")
        for name, value in measured.items():
            if not math.isfinite(value):
                raise self._error(step - 1, name)

    def _error(self, step: int, what: str) -> UserError:
        numbers = [int(one) for one in self.examples(step)]
        more = f" and {len(numbers) - NAMED_EXAMPLES} more" if len(numbers) > NAMED_EXAMPLES else ""
        named = " ".join(map(str, numbers[:NAMED_EXAMPLES]))
        return UserError(
            f"step {step + 1}: {what} is not finite at --learning-rate {self.rate:g}, examples {named}{more}; "
            f"{self.kept}; give a lower --learning-rate and another --out"
        )
