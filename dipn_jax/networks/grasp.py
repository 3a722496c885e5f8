"""GN: a score for every top-down grasp, from an RGB-D image turned so that the gripper closes along its rows."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx

from dipn_jax import geometry, render
from dipn_jax.errors import UserError
from dipn_jax.networks import resnet
from dipn_jax.workspace import ROTATIONS, WORKSPACE, grasp_angles

VIEW = 320
"""Pixels of the padded, rotated input: the turned 224 pixel map fits."""


MIN_DEPTH = 0.002
"""Metres of object that must be between the fingers; objects 25 mm high lie 5 mm over the lowest fingertip."""


@dataclasses.dataclass(frozen=True)
class GraspConfig:
    """Architecture. `paper` is as published; `compact` scores 16 rotations in a fraction of a second on a CPU."""

    preset: str = "compact"
    stages: tuple[int, ...] = (3, 4, 6, 3)  # paper: ResNet-50
    width: int = 24  # compact: channels at stride 4

    def __post_init__(self) -> None:
        if self.preset not in ("paper", "compact"):
            raise UserError(f"grasp network: preset {self.preset!r}; want paper or compact")


class _PaperTrunk(nnx.Module):
    """ResNet-50 FPN to level P2, then the published head with its two 11 x 57 convolutions."""

    def __init__(self, config: GraspConfig, rngs: nnx.Rngs) -> None:
        self.trunk = resnet.ResNet(4, config.stages, rngs)
        self.lateral = nnx.List([resnet.conv(256 * 2**i, 256, 1, rngs) for i in range(4)])
        self.smooth = resnet.conv(256, 256, 3, rngs)
        self.head1 = resnet.conv(256, 128, 3, rngs)
        self.norm1 = nnx.BatchNorm(128, rngs=rngs)
        self.head2 = resnet.conv(128, 128, 3, rngs)
        self.norm2 = nnx.BatchNorm(128, rngs=rngs)
        self.head3 = resnet.conv(128, 32, 3, rngs)
        self.norm3 = nnx.BatchNorm(32, rngs=rngs)
        self.dropout = nnx.Dropout(0.1, rngs=rngs)
        self.head4 = resnet.conv(32, 1, 3, rngs)
        self.wide1 = resnet.conv(1, 1, (11, 57), rngs)
        self.wide2 = resnet.conv(1, 1, (11, 57), rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        maps = self.trunk(x)
        y = self.lateral[3](maps[3])
        for level in (2, 1, 0):
            y = self.lateral[level](maps[level]) + resnet.upsample2(y)
        y = self.smooth(y)
        y = nnx.relu(self.norm1(self.head1(y)))
        y = nnx.relu(self.norm2(self.head2(y)))
        y = self.dropout(nnx.relu(self.norm3(self.head3(resnet.upsample2(y)))))
        y = resnet.upsample2(self.head4(y))
        return self.wide2(nnx.relu(self.wide1(y)))[..., 0]


class _CompactTrunk(nnx.Module):
    """Strides 4 and 8, read out by sub-pixel convolution; sees about 50 pixels around a grasp."""

    def __init__(self, config: GraspConfig, rngs: nnx.Rngs) -> None:
        w = config.width
        self.stem = resnet.conv(4 * 16, w, 3, rngs)
        self.block1 = resnet.PlainBlock(w, rngs)
        self.down = resnet.conv(w, 2 * w, 3, rngs, stride=2)
        self.block2 = resnet.PlainBlock(2 * w, rngs)
        self.block3 = resnet.PlainBlock(2 * w, rngs)
        self.up = resnet.conv(2 * w, w, 1, rngs)
        self.head = resnet.conv(w, 2 * w, 3, rngs)
        self.out = resnet.conv(2 * w, 16, 1, rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        fine = self.block1(nnx.relu(self.stem(resnet.space_to_depth(x, 4))))
        coarse = self.block3(self.block2(nnx.relu(self.down(fine))))
        both = nnx.relu(fine + resnet.upsample2(self.up(coarse)))
        return resnet.depth_to_space(self.out(nnx.relu(self.head(both))), 4)[..., 0]


class GraspNet(nnx.Module):
    """GN (Huang et al., ICRA 2021). Fully convolutional: trained on windows, applied to whole views."""

    def __init__(self, config: GraspConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.body = (_PaperTrunk if config.preset == "paper" else _CompactTrunk)(config, rngs)

    def __call__(self, images: jax.Array) -> jax.Array:
        """Logits `[B, H, W]` of grasps centred on each pixel that close along the rows.

        Args:
          images: `[B, H, W, 4]` RGB in [0, 1] and height in metres; sides divisible by 8 (`paper`: 32).
        """
        table = jnp.array([*render.TABLE_COLOR, 0.0])
        return self.body((images - table) / jnp.array([0.5, 0.5, 0.5, 0.05]))


def score_image(network: GraspNet, image: jax.Array) -> jax.Array:
    """All grasps of one image.

    Args:
      network: GN, in evaluation mode.
      image: `[224, 224, 4]`.

    Returns:
      Scores `[16, 224, 224]` in [0, 1]: closing axis at k * 22.5 degrees from +x, centred on the pixel.
    """
    table = jnp.array([*render.TABLE_COLOR, 0.0])
    # The gripper is its own mirror image: a grasp turned by half a turn is the same grasp, so the compact
    # form scores half of the rotations and repeats them.
    angles = jnp.asarray(grasp_angles())
    if network.config.preset == "compact":
        angles = angles[: ROTATIONS // 2]
    views = jax.vmap(lambda a: geometry.rotate_map(image - table, a, VIEW) + table)(angles)
    scores = nnx.sigmoid(network(views))
    scores = jax.vmap(lambda s, a: geometry.unrotate_map(s, a, WORKSPACE.pixels))(scores, angles)
    return jnp.tile(scores, (ROTATIONS // len(angles), 1, 1))


def geometric_labels(height: jax.Array) -> jax.Array:
    """Which grasps are free of physics' objections, from the height map of a turned view alone.

    A grasp centred on a pixel and closing along its row is positive when there is object between the
    fingers at the depth they would reach, and none where they come down. Finger zones: rows +-4 and
    columns 19 to 28 on each side (source: DIPN's released code; 2 mm a pixel, so 38 to 56 mm for
    fingers from 37 to 57 mm).

    Args:
      height: `[H, W]` metres.

    Returns:
      `[H, W]` float, 1 for positive.
    """
    tip = jnp.maximum(height - 0.04, 0.02)

    def highest(low: int, high: int, half_rows: int) -> jax.Array:
        rows, cols = 2 * half_rows + 1, high - low + 1
        pad = ((half_rows, half_rows), (-low if low < 0 else 0, high if high > 0 else 0))
        shifted = jnp.pad(height, pad)
        top = jax.lax.reduce_window(shifted, -jnp.inf, jax.lax.max, (rows, cols), (1, 1), "VALID")
        begin = low if low > 0 else 0
        return top[:, begin : begin + height.shape[1]]

    fingers = jnp.maximum(highest(-28, -19, 4), highest(19, 28, 4))
    return ((height > tip + MIN_DEPTH) & (fingers < tip)).astype(jnp.float32)
