"""Any number of rows in batches of fixed sizes."""

import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import batching


@pytest.mark.parametrize("count", [1, 16, 41, 130])
def test_rows_come_back_in_order_and_none_is_made_up(count: int) -> None:
    rows, sizes, filled = jnp.arange(count), set(), []

    def doubled(some: jnp.ndarray) -> jnp.ndarray:
        sizes.add(len(some))
        return 2 * some

    def marked(some: jnp.ndarray, real: np.ndarray) -> jnp.ndarray:
        filled.append(int(real.sum()))
        return doubled(some)

    np.testing.assert_array_equal(batching.in_batches(doubled, rows), 2 * np.arange(count))
    np.testing.assert_array_equal(batching.in_small_batches(marked, rows), 2 * np.arange(count))
    assert sizes <= {batching.BATCH, batching.SMALL_BATCH} and sum(filled) == count
