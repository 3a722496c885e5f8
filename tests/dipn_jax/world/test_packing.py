"""Packed scenes: objects side by side, on their faces, inside the workspace."""

import jax
import numpy as np
import pytest

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.world import packing, scenes
from dipn_jax.world.scenes import Ranges

PACKED = scenes.parse_objects("6", ranges=Ranges(packed=1.0))


def test_quarter_turns_are_the_rotations_of_a_cube() -> None:
    matrices = np.round(np.asarray(geometry.quat_to_matrix(packing.QUARTER_TURNS)), 5)
    assert len(np.unique(matrices.reshape(24, 9), axis=0)) == 24
    assert set(np.unique(np.abs(matrices))) == {0.0, 1.0}
    np.testing.assert_allclose(np.linalg.det(matrices), 1)


def test_objects_stand_side_by_side_without_room_for_a_finger() -> None:
    keys = jax.random.split(jax.random.key(0), 16)
    scene, poses = jax.vmap(lambda key: scenes.random_scene(key, config=PACKED))(keys)
    xy = np.asarray(poses)[..., :2]
    standing = np.asarray(poses)[..., 2].max(1) < 0.1  # those whose last object does not fall
    assert 4 < standing.sum() < 16
    assert np.abs(xy).max() < 0.2
    apart = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1) + np.eye(6)
    reach = np.linalg.norm(np.asarray(scene.size), axis=-1)
    # each has a neighbour whose centre is nearer than two objects and a finger would be
    assert (apart.min(-1)[standing] < reach[standing] + 0.012).all()
    assert (apart[standing] > 0.02).all(), "two objects in one place"


def test_a_share_of_scenes_is_packed() -> None:
    config = scenes.parse_objects("6", ranges=Ranges(packed=0.5))
    keys = jax.random.split(jax.random.key(1), 64)
    _, poses = jax.vmap(lambda key: scenes.random_scene(key, config=config))(keys)
    low = (np.sort(np.asarray(poses)[..., 2], 1)[:, -2] < 0.1).mean()
    assert 0.3 < low < 0.7


def test_more_objects_than_stand_in_rows_are_refused() -> None:
    ranges = Ranges(packed=0.1)
    assert scenes.parse_objects("3:12", ranges=ranges).slots == packing.MAX_OBJECTS
    with pytest.raises(UserError, match=r"--packed with up to 13 objects: no more than 12"):
        scenes.parse_objects("13", ranges=ranges)
