import cv2
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dipn_jax import geometry


def test_quaternions_are_mujocos() -> None:
    a, b = np.asarray(geometry.random_quat(jax.random.key(0), shape=(2,)), float)
    matrix, product = np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(matrix, a)
    mujoco.mju_mulQuat(product, a, b)
    np.testing.assert_allclose(geometry.quat_to_matrix(jnp.array(a)), matrix.reshape(3, 3), atol=1e-6)
    np.testing.assert_allclose(geometry.quat_multiply(jnp.array(a), jnp.array(b)), product, atol=1e-6)


def test_pixels_and_metres_round_trip() -> None:
    pixels = jnp.array([[0.0, 0.0], [223.0, 223.0], [17.5, 100.25]])
    np.testing.assert_allclose(geometry.metres_to_pixels(geometry.pixels_to_metres(pixels)), pixels, atol=1e-4)
    np.testing.assert_allclose(geometry.pixels_to_metres(jnp.array([111.5, 111.5])), 0.0, atol=1e-8)


def test_rotate_map_is_opencvs_warp(rng: np.random.Generator) -> None:
    image = cv2.GaussianBlur(rng.random((224, 224)).astype(np.float32), (0, 0), 6)
    angle, size = 0.6, 320
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    offset = np.array([111.5, 111.5]) - rotation @ np.array([159.5, 159.5])
    warp = np.column_stack([rotation, offset]).astype(np.float32)  # output pixel -> input pixel
    want = cv2.warpAffine(image, warp, (size, size), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    got = np.asarray(geometry.rotate_map(jnp.array(image), angle, size))
    # OpenCV rounds coordinates to 1/32 pixel first, so a few pixels fall on the other side
    assert np.isclose(got, want).mean() > 0.97
    assert np.abs(got - want).max() < 0.2


def test_unrotate_undoes_rotate() -> None:
    rows, cols = np.mgrid[:224, :224]
    image = jnp.array(rows + 1000.0 * cols, jnp.float32)
    back = geometry.unrotate_map(geometry.rotate_map(image, 0.4, 320), 0.4, 224)
    moved = np.abs(np.asarray(back - image))
    assert np.percentile(np.minimum(moved % 1000, 1000 - moved % 1000), 99) <= 1.0  # at most a pixel, by rounding


def test_planar_motion_recovers_a_planar_motion() -> None:
    before = jnp.array([[0.05, -0.02, 0.03, *np.asarray(geometry.random_quat(jax.random.key(1)))]])
    after = geometry.transform_poses(before, 0.7, jnp.array([0.01, 0.02]))
    center = jnp.array([[0.06, -0.03]])
    motion = geometry.planar_motion(before, after, center)[0]
    want = geometry.rotate2d(center[0], 0.7) + jnp.array([0.01, 0.02]) - center[0]
    np.testing.assert_allclose(motion, [*want, 0.7], atol=1e-5)
    np.testing.assert_array_equal(geometry.planar_motion(before, before, center), 0.0)
