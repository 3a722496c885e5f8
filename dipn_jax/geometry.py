"""Rigid motions, pixels and metres, image warps. Pure jax functions, float32."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key, Num, Shaped

from dipn_jax.structs import Array
from dipn_jax.workspace import WORKSPACE


def quat_to_matrix(quat: Float[Array, "*b 4"]) -> Float[jax.Array, "*b 3 3"]:
    """Return the rotation matrix of a unit quaternion (wxyz)."""
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(r, -1) for r in rows], -2)


def quat_multiply(a: Float[Array, "*#b 4"], b: Float[Array, "*#b 4"]) -> Float[jax.Array, "*b 4"]:
    """Return the Hamilton product of two quaternions (wxyz): rotate by `b`, then by `a`."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quat_about_z(angle: Float[Array, "*b"] | float) -> Float[jax.Array, "*b 4"]:
    """Return the quaternion (wxyz) of a rotation by `angle` radians about z."""
    half = jnp.asarray(angle) / 2
    zero = jnp.zeros_like(half)
    return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], -1)


def random_quat(key: Key[Array, ""], *, shape: tuple[int, ...] = ()) -> Float[jax.Array, "*shape 4"]:
    """Return uniformly random rotations as quaternions (wxyz)."""
    q = jax.random.normal(key, (*shape, 4))
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)


def wrap_angle(angle: Float[Array, "*b"]) -> Float[jax.Array, "*b"]:
    """Return the same angle (radians) in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def rotate2d(xy: Num[Array, "*#b 2"], angle: Float[Array, "*#b"] | float) -> Float[jax.Array, "*b 2"]:
    """Rotate points by `angle` radians about the origin."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y = xy[..., 0], xy[..., 1]
    return jnp.stack([c * x - s * y, s * x + c * y], -1)


def metres_to_pixels(xy: Float[Array, "*b 2"]) -> Float[Array, "*b 2"]:
    """Convert workspace metres (x, y) to fractional pixels (col, row); pixel centres are integers."""
    return (xy + WORKSPACE.half) / WORKSPACE.pixel - 0.5


def pixels_to_metres(pixels: Num[Array, "*b 2"]) -> Float[jax.Array, "*b 2"]:
    """Convert fractional pixels (col, row) to workspace metres (x, y)."""
    return (jnp.asarray(pixels, jnp.float32) + 0.5) * WORKSPACE.pixel - WORKSPACE.half


def transform_poses(
    poses: Float[Array, "N 7"], angle: Float[Array, ""] | float, shift: Float[Array, " 2"]
) -> Float[jax.Array, "N 7"]:
    """Rotate poses by `angle` radians about the workspace's origin, then shift them by `shift` metres."""
    xy = rotate2d(poses[..., :2], angle) + shift
    quat = quat_multiply(quat_about_z(angle), poses[..., 3:])
    return jnp.concatenate([xy, poses[..., 2:3], quat], -1)


def planar_angle(before: Float[Array, "*#b 4"], after: Float[Array, "*#b 4"]) -> Float[jax.Array, "*b"]:
    """Return the rotation about z (radians) that is nearest to the turn between two quaternions (wxyz).

    It maximizes the trace of Rz(angle)^T R, with R the turn as a matrix: exact for a turn about z.
    """
    turn = quat_multiply(after, before * jnp.array([1.0, -1.0, -1.0, -1.0]))
    # for R = (w, x, y, z): R10 - R01 = 4 w z and R00 + R11 = 2 (w^2 - z^2) for a unit quaternion
    w, z = turn[..., 0], turn[..., 3]
    # + 0.0 turns -0.0 into 0.0, so that no motion is 0 and not pi
    return jnp.arctan2(4 * w * z, 2 * (w * w - z * z) + 1e-12)


def planar_motion(
    before: Float[Array, "*#b 7"], after: Float[Array, "*#b 7"], center: Float[Array, "*#b 2"]
) -> Float[jax.Array, "*b 3"]:
    """Return the motion (dx, dy metres, dtheta radians) of a planar body between two poses.

    Args:
      before: poses before.
      after: poses after.
      center: metres, the point of the body that (dx, dy) is the displacement of.
    """
    angle = planar_angle(before[..., 3:], after[..., 3:])
    arm = rotate2d(center - before[..., :2], angle)
    shift = after[..., :2] + arm - center
    return jnp.concatenate([shift, angle[..., None]], -1)


def view_grid(height: int, width: int) -> Float[jax.Array, "{height} {width} 2"]:
    """Return the pixel centres of a map as (col, row)."""
    rows, cols = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    return jnp.stack([cols, rows], -1).astype(jnp.float32)


def sample_nearest(
    image: Shaped[Array, "H W *c"], pixels: Float[Array, "*b 2"], fill: float | int = 0
) -> Shaped[jax.Array, "*_"]:
    """Return the pixels of `image` that are nearest to fractional `pixels` (col, row), `[*b, *c]`; `fill` outside."""
    h, w = image.shape[:2]
    at = jnp.round(pixels).astype(jnp.int32)
    col, row = at[..., 0], at[..., 1]
    inside = (col >= 0) & (col < w) & (row >= 0) & (row < h)
    flat = image.reshape(h * w, *image.shape[2:])
    value = flat[jnp.clip(row, 0, h - 1) * w + jnp.clip(col, 0, w - 1)]
    return jnp.where(inside.reshape(inside.shape + (1,) * (value.ndim - inside.ndim)), value, fill)


def rotate_map(
    image: Shaped[Array, "H W *c"], angle: Float[Array, ""] | float, size: int, fill: float | int = 0
) -> Shaped[jax.Array, "{size} {size} *c"]:
    """Rotate a map about its centre by `-angle`, so that direction `angle` becomes that of the columns (+x).

    Args:
      image: a map, or several in its last axes.
      angle: radians.
      size: side of the result in pixels.
      fill: value outside.

    Returns:
      The turned map, nearest neighbour.
    """
    h, w = image.shape[:2]
    middle = jnp.array([(w - 1) / 2, (h - 1) / 2])
    out = view_grid(size, size) - (size - 1) / 2
    return sample_nearest(image, rotate2d(out, angle) + middle, fill)


def unrotate_map(
    image: Shaped[Array, "H W *c"], angle: Float[Array, ""] | float, size: int
) -> Shaped[jax.Array, "{size} {size} *c"]:
    """Return an image turned back: the inverse of `rotate_map`, 0 beyond its border."""
    return rotate_map(image, -angle, size)
