"""The traced rollout's model of a scene."""

import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax.physics import mjx
from dipn_jax.physics.mjx_program import Program
from dipn_jax.structs import Scene


@pytest.mark.slow
def test_the_hulls_of_the_grippers_boxes_are_these_boxes() -> None:
    program = Program(mjx.DEFAULTS, 1, substeps=1)
    scene = Scene(jnp.zeros(1, jnp.int32), jnp.full((1, 3), 0.05), jnp.zeros((1, 3)), jnp.ones(1), jnp.ones(1))
    corners = program._fields(scene)["_impl.mesh_convex"][0].vert
    size, radius = np.asarray(program.base.geom_size), np.asarray(program.base.geom_rbound)
    assert program.first_geom > 3
    for geom in range(1, program.first_geom):  # the first is the floor
        np.testing.assert_allclose(np.abs(corners[geom]).max(0), size[geom], rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(corners[geom], axis=-1).max(), radius[geom], rtol=1e-6)
