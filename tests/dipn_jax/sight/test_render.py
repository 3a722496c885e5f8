from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import geometry, structs
from dipn_jax.physics import native
from dipn_jax.sight import render
from dipn_jax.structs import ABSENT


def test_heights_and_labels_are_the_ray_casters(settled: Any) -> None:
    want_height, want_label = native.raycast(settled.scene, settled.poses)
    height, label = (np.asarray(x) for x in jax.vmap(render.render_depth)(settled.scene, jnp.asarray(settled.poses)))
    same = label == want_label
    assert same.mean() > 0.9999
    # on a face that is nearly upright a thousandth of a millimetre sideways is a tenth in height
    assert (np.abs(height - want_height)[same] < 1e-4).mean() > 0.9999
    assert (label != ABSENT).any((1, 2)).all(), "objects are in view"


def test_batch_elements_do_not_interact(settled: Any) -> None:
    together = jax.vmap(render.render_depth)(settled.scene, jnp.asarray(settled.poses))
    alone = render.render_depth(structs.take(settled.scene, 2), settled.poses[2])
    np.testing.assert_array_equal(together[1][2], alone[1])


def test_a_view_of_turned_poses_is_the_turned_view(settled: Any) -> None:
    scene, poses = structs.take(settled.scene, 0), jnp.asarray(settled.poses[0])
    _, label = render.render_depth(scene, poses)
    turned = geometry.transform_poses(poses, -0.5, jnp.zeros(2))
    _, direct = render.render_depth(scene, turned, pixels=320)
    warped = geometry.rotate_map(label, 0.5, 320, fill=ABSENT)
    both = (np.asarray(direct) >= 0) & (np.asarray(warped) >= 0)
    either = (np.asarray(direct) >= 0) | (np.asarray(warped) >= 0)
    assert both.sum() / either.sum() > 0.95  # half a pixel of sampling all around objects of some 30 pixels


@pytest.mark.slow
def test_gradients_of_height_are_finite(settled: Any) -> None:
    scene, poses = structs.take(settled.scene, 0), jnp.asarray(settled.poses[0])
    scene = scene.replace(shape=np.where(np.arange(len(scene.shape)) == 1, ABSENT, scene.shape))

    def mean_height(size: jax.Array, poses: jax.Array) -> jax.Array:
        return render.render_depth(scene.replace(size=size), poses)[0].mean()

    by_size, by_pose = jax.grad(mean_height, (0, 1))(jnp.asarray(scene.size), poses)
    assert np.isfinite(by_size).all() and np.isfinite(by_pose).all()
    assert (np.asarray(by_size).sum(-1) > 0).sum() >= 3 and (by_size[1] == 0).all()  # a hidden object has none
    assert (by_pose[:, 2] > 0).sum() >= 3


def test_colors_follow_labels(settled: Any) -> None:
    scene = structs.take(settled.scene, 0)
    seen = render.render(scene, settled.poses[0])
    label = np.asarray(seen.label)
    want = np.concatenate([scene.color, [render.TABLE_COLOR]])[label]
    np.testing.assert_allclose(seen.color, want, atol=1e-6)
