"""The leaves of stored pytrees: arrays, and random keys, which are stored as their numbers."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def is_key(leaf: Any) -> bool:
    """Return whether a leaf is a random key (dropout's), which is stored as its numbers."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def stored_shape(leaf: Any) -> tuple[int, ...]:
    """Return the shape that a leaf is stored in."""
    return np.shape(jax.random.key_data(leaf) if is_key(leaf) else leaf)


def on_device(stored: np.ndarray, *, like: Any) -> jax.Array:
    """Return a copy of `stored` on the default device (training donates its buffers); a random key if `like` is one."""
    array = jnp.array(stored)
    return jax.random.wrap_key_data(array, impl=jax.random.key_impl(like)) if is_key(like) else array
