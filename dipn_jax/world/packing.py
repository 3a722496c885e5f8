"""Packed scenes: objects placed side by side in rows that no gripper fits into, as in the hard cases."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from dipn_jax import geometry
from dipn_jax.structs import Array
from dipn_jax.world import shapes

MAX_ROWS = 3
"""Largest number of rows in a scene."""
MAX_OBJECTS = 4 * MAX_ROWS
"""Largest number of objects in a scene: four in a row."""
GAP_RANGE = (0.0005, 0.004)
"""Smallest and largest gap between neighbours in metres; a finger is thicker."""
MAX_OFFSET = 0.13
"""Largest distance of the rows' middle from the workspace's centre in x or y, less half their diagonal, in metres."""
DROPPED_SHARE = 0.3
"""Share of scenes in which the last object is dropped onto or beside the others."""


def _quarter_turns() -> Float[np.ndarray, "24 4"]:
    """Return the quaternions (wxyz) of the 24 rotations that map a cube onto itself."""
    whole = [np.array(v, float) for v in itertools.product((0, 1, -1), repeat=4) if np.abs(v).sum() in (1, 2, 4)]
    first = [v / np.linalg.norm(v) for v in whole if v[np.flatnonzero(v)[0]] > 0]  # q and -q are one rotation
    return np.unique(np.round(first, 12), axis=0).astype(np.float32)


QUARTER_TURNS = _quarter_turns()
"""Rotations `[24, 4]` (wxyz) that map a cube onto itself."""


def pack(
    key: Key[Array, ""], shape: Int[Array, " N"], size: Float[Array, "N 3"], present: Bool[Array, " N"]
) -> Float[jax.Array, "N 7"]:
    """Place objects side by side in up to MAX_ROWS rows, each on one of its faces, all turned by the same angle.

    Args:
      key: random key.
      shape: index into `shapes.CLASSES`; ABSENT where there is none.
      size: metres.
      present: which slots hold an object.

    Returns:
      Poses, a millimetre above the table; in a share of scenes the last object is 0.2 m up, in a random orientation.
    """
    n = shape.shape[0]
    keys = jax.random.split(key, 8)
    turn = jnp.asarray(QUARTER_TURNS)[jax.random.randint(keys[0], (n,), 0, len(QUARTER_TURNS))]
    extent = jnp.einsum("nij,nj->ni", jnp.abs(geometry.quat_to_matrix(turn)), size)
    rows = jax.random.randint(keys[1], (), 1, MAX_ROWS + 1)
    rows = jnp.maximum(rows, (present.sum() + 3) // 4)  # at most four in a row, as far as MAX_ROWS allow it
    row = jnp.arange(n) % rows
    gap = jax.random.uniform(keys[2], (n,), minval=GAP_RANGE[0], maxval=GAP_RANGE[1])
    same = (row[:, None] == row) & present
    before = same & (jnp.arange(n) < jnp.arange(n)[:, None])
    length = jnp.where(same, extent[:, 0] + gap, 0.0).sum(1)
    x = jnp.where(before, extent[:, 0] + gap, 0.0).sum(1) + extent[:, 0] / 2 - length / 2
    depth = jnp.stack([jnp.where((row == r) & present, extent[:, 1], 0.0).max() for r in range(MAX_ROWS)])
    lines = jnp.concatenate([jnp.zeros(1), jnp.cumsum(depth + gap[0])])
    y = lines[row] + depth[row] / 2 - lines[-1] / 2
    jitter = jnp.deg2rad(jax.random.uniform(keys[3], (n,), minval=-2.0, maxval=2.0))
    yaw = jax.random.uniform(keys[4], (), maxval=2 * jnp.pi)
    room = jnp.maximum(MAX_OFFSET - jnp.hypot(length.max(), lines[-1]) / 2, 0.0)
    shift = jax.random.uniform(keys[5], (2,), minval=-1.0, maxval=1.0) * room
    middle = geometry.rotate2d(jnp.stack([x, y], -1), yaw) + shift
    quat = geometry.quat_multiply(geometry.quat_about_z(yaw + jitter), turn)
    center = jnp.column_stack([middle, extent[:, 2] / 2 + 0.001])
    falls = jax.random.bernoulli(keys[6], DROPPED_SHARE) & (jnp.arange(n) == present.sum() - 1)
    spot = jax.random.uniform(keys[7], (2,), minval=-0.1, maxval=0.1)
    center = jnp.where(falls[:, None], jnp.append(spot, 0.2), center)
    tumbled = geometry.random_quat(keys[6], shape=(n,))
    quat = jnp.where(falls[:, None], tumbled, quat)
    offset = jnp.asarray(shapes.UNIT_CENTER_OF_MASS, jnp.float32)[jnp.maximum(shape, 0)] * size
    mass_center = center + jnp.einsum("nij,nj->ni", geometry.quat_to_matrix(quat), offset)
    return jnp.concatenate([mass_center, quat], -1)
