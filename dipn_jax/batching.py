"""Calls of compiled functions with any number of rows, in batches of two fixed sizes."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax.system import forking

BATCH = 64
"""Rows that a compiled function takes at a time."""
SMALL_BATCH = 16
"""Rows taken at a time where each row is expensive, or where few are left."""
SIDE_BY_SIDE = 2
"""Small batches computed at the same time: XLA on a CPU uses two cores badly for one of GN."""


def in_batches(function: Callable[..., Any], *args: Any) -> Any:
    """Return `function(*args)` for any number of rows, computed BATCH or SMALL_BATCH rows at a time.

    So two compiled shapes serve any number of rows.

    Args:
      function: jitted, of pytrees with a leading axis, each row by itself.
      args: pytrees with a leading axis.

    Returns:
      What `function` returns, its rows joined.
    """
    forking.check()
    count = len(jax.tree.leaves(args)[0])
    parts, start = [], 0
    while start < count:
        size = BATCH if count - start > BATCH - SMALL_BATCH else SMALL_BATCH
        rows = np.arange(start, start + size) % count
        parts.append(function(*jax.tree.map(lambda leaf, rows=rows: leaf[rows], args)))
        start += size
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)


def each_row(function: Callable[..., Any], rows: Any) -> Any:
    """Return `function` of each row, traced: one after another on a CPU, SMALL_BATCH at a time on an accelerator.

    Args:
      function: of a row of `rows`.
      rows: pytree with a leading axis.
    """
    return jax.lax.map(function, rows, batch_size=None if jax.default_backend() == "cpu" else SMALL_BATCH)


def in_small_batches(function: Callable[..., Any], *args: Any) -> Any:
    """Return `function(*args)` as `in_batches` does, always SMALL_BATCH rows at a time, for expensive rows.

    `function(*rows, real)` also gets `real [SMALL_BATCH]` bool: which of its rows are rows of `args`. The others only
    fill the batch up.

    Args:
      function: jitted, of pytrees with a leading axis, and of `real [SMALL_BATCH]` bool.
      args: pytrees with a leading axis.
    """
    forking.check()
    count = len(jax.tree.leaves(args)[0])

    def part(start: int) -> Any:
        rows = np.arange(start, start + SMALL_BATCH)
        some = jax.tree.map(lambda leaf: leaf[rows % count], args)
        return jax.device_get(function(*some, rows < count))

    parts = [part(0)]  # alone, because it may have to be compiled
    with concurrent.futures.ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        parts += pool.map(part, range(SMALL_BATCH, count, SMALL_BATCH))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
