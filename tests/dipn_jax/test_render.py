from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dipn_jax import geometry, model, render, structs
from dipn_jax.structs import ABSENT


def raycast(scene: Any, poses: np.ndarray, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights and labels from MuJoCo's ray caster, one vertical ray a pixel."""
    m = mujoco.MjModel.from_xml_string(model.mjcf(scene, config=model.PhysicsConfig()))
    d = mujoco.MjData(m)
    d.qpos[2] = 3.0  # the gripper is above the camera
    d.qpos[model.GRIPPER_DOF :] = poses.reshape(-1)
    mujoco.mj_forward(m, d)
    at = (np.arange(pixels) - (pixels - 1) / 2) * 0.002
    height, label = np.zeros((pixels, pixels)), np.full((pixels, pixels), ABSENT)
    first = m.body("o0").id
    hit = np.zeros(1, np.int32)
    for row, y in enumerate(at):
        for col, x in enumerate(at):
            distance = mujoco.mj_ray(m, d, np.array([x, y, 1.0]), np.array([0, 0, -1.0]), None, 1, -1, hit)
            body = m.geom_bodyid[hit[0]]
            if body >= first:
                height[row, col], label[row, col] = 1 - distance, body - first
    return height, label


@pytest.mark.parametrize("index", [0, 1])
def test_heights_and_labels_are_the_ray_casters(settled: Any, index: int) -> None:
    scene, poses = structs.take(settled.scene, index), settled.poses[index]
    height, label = render.render_depth(scene, poses)
    want_height, want_label = raycast(scene, poses, 224)
    assert (np.asarray(label) == want_label).mean() > 0.9999
    same = np.asarray(label) == want_label
    assert np.abs(np.asarray(height) - want_height)[same].max() < 1e-4
    assert len(np.unique(label)) > 3, "objects are in view"


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


def test_gradient_of_height_is_finite(settled: Any) -> None:
    scene, poses = jax.tree.map(lambda leaf: leaf[0, :1], settled.scene), jnp.asarray(settled.poses[0, :1])

    def mean_height(z: jax.Array) -> jax.Array:
        return render.render_depth(scene, poses.at[:, 2].add(z))[0].mean()

    gradient = jax.jacfwd(mean_height)(jnp.float32(0.0))
    assert np.isfinite(gradient) and gradient > 0


def test_colors_follow_labels(settled: Any) -> None:
    scene = structs.take(settled.scene, 0)
    seen = render.render(scene, settled.poses[0])
    label = np.asarray(seen.label)
    want = np.concatenate([scene.color, [render.TABLE_COLOR]])[label]
    np.testing.assert_allclose(seen.color, want, atol=1e-6)
