"""Fixed dimensions of the workspace."""

import numpy as np

from dipn_jax.workspace import grasp_angles


def test_the_angles_are_sixteen_even_ones() -> None:
    np.testing.assert_allclose(grasp_angles(), np.arange(16) * np.pi / 8, atol=1e-6)
