from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import geometry, structs
from dipn_jax.networks import losses
from dipn_jax.sight import imagine, masks, render
from dipn_jax.structs import ABSENT


def _seen(settled: Any, index: int) -> Any:
    scene = structs.take(settled.scene, index)
    return scene, render.render(scene, settled.poses[index])


def test_no_motion_is_the_same_image(settled: Any) -> None:
    _, seen = _seen(settled, 0)
    centers, _ = masks.mask_centers(seen.label, 5)
    same = imagine.imagine(seen, centers, jnp.zeros((5, 3)))
    np.testing.assert_array_equal(same.label, seen.label)
    np.testing.assert_allclose(same.height, seen.height, atol=1e-7)
    np.testing.assert_allclose(same.color, seen.color, atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 0.3, -1.2, 2.9])
def test_a_moved_image_is_the_render_of_the_moved_scene(settled: Any, angle: float) -> None:
    # one object, moved in the plane: the camera sees it unchanged but for the motion
    scene, seen = _seen(settled, 1)
    only = scene.replace(shape=np.where(np.arange(5) == 0, scene.shape, ABSENT))
    seen = render.render(only, settled.poses[1])
    centers, _ = masks.mask_centers(seen.label, 5)
    before = jnp.asarray(settled.poses[1])
    middle = geometry.transform_poses(before, 0.0, -before[0, :2])
    after = geometry.transform_poses(middle, angle, jnp.array([0.02, -0.01]))
    motion = geometry.planar_motion(before, after, centers)
    predicted = imagine.imagine(seen, centers, motion)
    _, label = render.render_depth(only, after)
    error, _ = losses.mask_errors(predicted.label, label, 5)
    assert error[0] < 0.06  # nearest-neighbour sampling of a 20 to 50 pixel wide object


def test_the_moved_mask_is_opencvs_warp(settled: Any) -> None:
    _, seen = _seen(settled, 2)
    centers, _ = masks.mask_centers(seen.label, 5)
    motion = np.zeros((5, 3), np.float32)
    motion[0] = [0.03, 0.01, 0.5]
    mask = (np.asarray(seen.label) == 0).astype(np.uint8)
    only = seen.replace(label=jnp.where(seen.label == 0, 0, ABSENT))
    got = np.asarray(imagine.imagine(only, centers, jnp.array(motion)).label == 0)
    col, row = np.asarray(geometry.metres_to_pixels(centers[0]))
    warp = cv2.getRotationMatrix2D((float(col), float(row)), -np.degrees(0.5), 1.0)  # OpenCV's angle is the other way
    warp[:, 2] += [15, 5]
    want = cv2.warpAffine(mask, warp, (224, 224), flags=cv2.INTER_NEAREST) > 0
    assert (got & want).sum() / (got | want).sum() > 0.97


def test_the_higher_object_hides_the_lower() -> None:
    label = jnp.full((224, 224), ABSENT).at[100:110, 100:110].set(0).at[100:110, 140:150].set(1)
    height = jnp.where(label == 0, 0.02, jnp.where(label == 1, 0.05, 0.0))
    from dipn_jax.structs import Observation

    seen = Observation(height, jnp.zeros((224, 224, 3)), label, 2)
    centers, _ = masks.mask_centers(label, 2)
    onto = jnp.array([[0.08, 0.0, 0.0], [0.0, 0.0, 0.0]])
    after = imagine.imagine(seen, centers, onto)
    assert (after.label == 1).sum() == 100 and (after.label == 0).sum() == 0


def test_move_toward_finds_the_first_object() -> None:
    label = jnp.full((224, 224), ABSENT).at[105:120, 120:130].set(1).at[105:120, 140:150].set(0)
    assert imagine.first_object_hit(label, jnp.zeros(2), jnp.float32(0.0)) == 1
    assert imagine.first_object_hit(label, jnp.zeros(2), jnp.float32(np.pi)) == ABSENT
