"""Rigid motions, pixels and metres, image warps. Pure jax functions, float32."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dipn_jax.structs import Array
from dipn_jax.workspace import WORKSPACE


def quat_to_matrix(quat: Array) -> Array:
    """Rotation matrix `[..., 3, 3]` of a unit quaternion `[..., 4]` (wxyz)."""
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(r, -1) for r in rows], -2)


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions `[..., 4]` (wxyz): rotate by `b`, then by `a`."""
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


def quat_about_z(angle: Array) -> Array:
    """Quaternion `[..., 4]` (wxyz) of a rotation by `angle [...]` radians about z."""
    half = jnp.asarray(angle) / 2
    zero = jnp.zeros_like(half)
    return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], -1)


def random_quat(key: Array, *, shape: tuple[int, ...] = ()) -> Array:
    """Uniformly random rotations `[*shape, 4]` (wxyz)."""
    q = jax.random.normal(key, (*shape, 4))
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)


def wrap_angle(angle: Array) -> Array:
    """The same angle in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def rotate2d(xy: Array, angle: Array) -> Array:
    """Points `[..., 2]` rotated by `angle [...]` radians about the origin."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y = xy[..., 0], xy[..., 1]
    return jnp.stack([c * x - s * y, s * x + c * y], -1)


def metres_to_pixels(xy: Array) -> Array:
    """Workspace metres `[..., 2]` (x, y) to fractional pixels `[..., 2]` (col, row); centres are integers."""
    return (xy + WORKSPACE.half) / WORKSPACE.pixel - 0.5


def pixels_to_metres(pixels: Array) -> Array:
    """Inverse of `metres_to_pixels`."""
    return (jnp.asarray(pixels, jnp.float32) + 0.5) * WORKSPACE.pixel - WORKSPACE.half


def transform_poses(poses: Array, angle: Array, shift: Array) -> Array:
    """Poses `[N, 7]` rotated by `angle []` about the workspace's origin, then shifted by `shift [2]` metres."""
    xy = rotate2d(poses[..., :2], angle) + shift
    quat = quat_multiply(quat_about_z(angle), poses[..., 3:])
    return jnp.concatenate([xy, poses[..., 2:3], quat], -1)


def planar_angle(before: Array, after: Array) -> Array:
    """The rotation about z `[...]` (radians) nearest to the turn between two quaternions `[..., 4]`.

    It maximizes the trace of Rz(angle)^T R, with R the turn as a matrix: exact for a turn about z.
    """
    turn = quat_multiply(after, before * jnp.array([1.0, -1.0, -1.0, -1.0]))
    # for R = (w, x, y, z): R10 - R01 = 4 w z and R00 + R11 = 2 (w^2 - z^2) for a unit quaternion
    w, z = turn[..., 0], turn[..., 3]
    # + 0.0 turns -0.0 into 0.0, so that no motion is 0 and not pi
    return jnp.arctan2(4 * w * z, 2 * (w * w - z * z) + 1e-12)


def planar_motion(before: Array, after: Array, center: Array) -> Array:
    """Motion `[N, 3]` (dx, dy metres, dtheta radians) of a planar body between two poses `[N, 7]`.

    Args:
      before: poses before.
      after: poses after.
      center: `[N, 2]` metres, the point of the body that (dx, dy) is the displacement of.
    """
    angle = planar_angle(before[..., 3:], after[..., 3:])
    arm = rotate2d(center - before[..., :2], angle)
    shift = after[..., :2] + arm - center
    return jnp.concatenate([shift, angle[..., None]], -1)


def view_grid(height: int, width: int) -> Array:
    """Pixel centres `[height, width, 2]` as (col, row)."""
    rows, cols = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    return jnp.stack([cols, rows], -1).astype(jnp.float32)


def sample_nearest(image: Array, pixels: Array, fill: float | int = 0) -> Array:
    """`image [H, W, ...]` at fractional `pixels [..., 2]` (col, row), nearest; `fill` outside."""
    h, w = image.shape[:2]
    at = jnp.round(pixels).astype(jnp.int32)
    col, row = at[..., 0], at[..., 1]
    inside = (col >= 0) & (col < w) & (row >= 0) & (row < h)
    flat = image.reshape(h * w, *image.shape[2:])
    value = flat[jnp.clip(row, 0, h - 1) * w + jnp.clip(col, 0, w - 1)]
    return jnp.where(inside.reshape(inside.shape + (1,) * (value.ndim - inside.ndim)), value, fill)


def rotate_map(image: Array, angle: Array, size: int, fill: float | int = 0) -> Array:
    """A map turned about its centre by `-angle`, so that direction `angle` becomes the columns' (+x).

    Args:
      image: `[H, W, ...]`.
      angle: `[]` radians.
      size: side of the result in pixels.
      fill: value outside.

    Returns:
      `[size, size, ...]`, nearest neighbour.
    """
    h, w = image.shape[:2]
    middle = jnp.array([(w - 1) / 2, (h - 1) / 2])
    out = view_grid(size, size) - (size - 1) / 2
    return sample_nearest(image, rotate2d(out, angle) + middle, fill)


def unrotate_map(image: Array, angle: Array, size: int, fill: float | int = 0) -> Array:
    """Inverse of `rotate_map`: `[H, W, ...]` back to `[size, size, ...]`."""
    return rotate_map(image, -angle, size, fill)
