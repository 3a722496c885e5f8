"""GN: scores every top-down grasp, from an RGB-D image that is turned so that the gripper closes along its rows."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float, Int

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.names import ALL_AIDS, Aid
from dipn_jax.networks import resnet
from dipn_jax.sight import fingers, render
from dipn_jax.workspace import ROTATIONS, TURNED_PIXELS, WORKSPACE, grasp_angles

VIEW_PIXELS = TURNED_PIXELS
"""Pixels of the padded, rotated input."""
INPUT_SCALE = (0.5, 0.5, 0.5, 0.05)
"""Divisors of red, green, blue (in [0, 1]) and height (metres)."""
CELL_PIXELS = 4
"""Pixels along a side of a cell; the compact network works on cells."""


@dataclasses.dataclass(frozen=True)
class GraspConfig:
    """Architecture. `paper` is as published; `compact` scores 16 rotations in a fraction of a second on a CPU."""

    preset: str = "compact"  # or paper
    stages: tuple[int, ...] = (3, 4, 6, 3)  # paper: ResNet-50
    width: int = 24  # compact: channels at stride 4
    coarse: int = 48  # compact: channels at stride 8
    blocks: int = 2  # compact: residual blocks at stride 8

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

    def __call__(self, x: Float[jax.Array, "B H W 4"]) -> Float[jax.Array, "B H W"]:
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
        fine, coarse = config.width, config.coarse
        self.stem = resnet.conv(4 * CELL_PIXELS**2, fine, 3, rngs)
        self.down = resnet.conv(fine, coarse, 3, rngs, stride=2)
        self.blocks = nnx.List([resnet.PlainBlock(coarse, rngs) for _ in range(config.blocks)])
        self.up = resnet.conv(coarse, 4 * fine, 1, rngs)
        self.head = resnet.conv(fine, 2 * fine, 3, rngs)
        self.out = resnet.conv(2 * fine, CELL_PIXELS**2, 1, rngs)

    def cells(self, x: Float[jax.Array, "B h w 64"]) -> Float[jax.Array, "B h w 16"]:
        """Return logits of the pixels of cells; h and w even."""
        fine = nnx.relu(self.stem(x))
        coarse = nnx.relu(self.down(fine))
        for block in self.blocks:
            coarse = block(coarse)
        both = nnx.relu(fine + resnet.depth_to_space(self.up(coarse), 2))
        return self.out(nnx.relu(self.head(both)))

    def __call__(self, x: Float[jax.Array, "B H W 4"]) -> Float[jax.Array, "B H W"]:
        return resnet.depth_to_space(self.cells(resnet.space_to_depth(x, CELL_PIXELS)), CELL_PIXELS)[..., 0]


class GraspNet(nnx.Module):
    """GN (Huang et al., ICRA 2021). Fully convolutional: trained on windows, applied to whole views."""

    def __init__(self, config: GraspConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.body = (_PaperTrunk if config.preset == "paper" else _CompactTrunk)(config, rngs)

    def __call__(self, images: Float[jax.Array, "B H W 4"]) -> Float[jax.Array, "B H W"]:
        """Return logits of grasps centred on each pixel that close along the rows.

        Args:
          images: RGB in [0, 1] and height in metres; sides divisible by 8 (`paper`: 32).
        """
        return self.body(_normalized(images)).astype(jnp.float32)


def _normalized(images: Float[jax.Array, "*b H W 4"]) -> Float[jax.Array, "*b H W 4"]:
    """Return images as the network gets them: the table is 0."""
    return (images - jnp.array([*render.TABLE_COLOR, 0.0])) / jnp.array(INPUT_SCALE)


def score_image(
    network: GraspNet,
    image: Float[jax.Array, "224 224 4"],
    *,
    action: Literal["grasp", "push"] = "grasp",
    squash: Callable[[jax.Array], jax.Array] = nnx.sigmoid,
    table: bool = True,
    lowest: float = 0.0,
) -> Float[jax.Array, "16 224 224"]:
    """Return the scores of all grasps, or all pushes, of one image.

    Args:
      network: GN, or another of its kind, in evaluation mode.
      image: RGB in [0, 1] and height in metres.
      action: grasps are scored by the `compact` network at half of the rotations, because a grasp turned by half a turn
        is the same grasp, and score `lowest` on empty table; pushes are scored at all rotations, and everywhere.
      squash: function from the network's outputs to scores.
      table: whether grasps centred on empty table score `lowest`; False: what the network says, which never grasped
        there.
      lowest: 0 for chances, -inf for values, which may be negative everywhere.

    Returns:
      Scores in [0, 1]: closing axis at k * 22.5 degrees from +x, centred on the pixel.
    """
    if network.config.preset == "compact":
        turns = ROTATIONS // 2 if action == "grasp" else ROTATIONS
        _, back = turning_tables(turns)
        scores = squash(score_cells(network, image, turns)).reshape(-1)[back]
        scores = jnp.tile(scores, (ROTATIONS // turns, 1, 1))
    else:
        angles = jnp.asarray(grasp_angles())
        empty = jnp.array([*render.TABLE_COLOR, 0.0])
        views = jax.vmap(lambda a: geometry.rotate_map(image - empty, a, VIEW_PIXELS) + empty)(angles)
        scores = squash(network(views))
        scores = jax.vmap(lambda s, a: geometry.unrotate_map(s, a, WORKSPACE.pixels))(scores, angles)
    return jnp.where(image[..., 3] > fingers.EMPTY_HEIGHT, scores, lowest) if action == "grasp" and table else scores


def aided_scores(
    network: GraspNet,
    image: Float[jax.Array, "224 224 4"],
    *,
    aids: Collection[Aid] = ALL_AIDS,
    squash: Callable[[jax.Array], jax.Array] = nnx.sigmoid,
    lowest: float = 0.0,
) -> Float[jax.Array, "16 224 224"]:
    """Return the scores by which a grasp is chosen: the network's, changed by the given aids (`names.Aid`).

    mirrors: a mirror image of a grasp is as good as the grasp, and both mirrors map the 16 angles onto themselves, so
    there are four scores of each grasp. The best of a million scores is an overestimate; the least of four makes up
    for it. fingers, border: blocked grasps (`fingers.blocked_image`) get half the score. What each aid is worth is in
    docs/clearing.md.

    Args:
      network: GN, or another of its kind, in evaluation mode.
      image: RGB in [0, 1] and height in metres.
      aids: those wanted; `top`, `still` and `memory` are not about the scores of one image.
      squash: function from the network's outputs to scores.
      lowest: as of `score_image`.
    """
    score = functools.partial(score_image, network, squash=squash, table="table" in aids, lowest=lowest)
    scores = score(image)
    if "mirrors" in aids:
        scores = functools.reduce(jnp.minimum, [_mirrored(score, image, axes) for axes in ((0,), (1,), (0, 1))], scores)
    if "fingers" in aids or "border" in aids:
        blocked = fingers.blocked_image(image[..., 3], inside="fingers" in aids, beyond="border" in aids)
        scores = jnp.minimum(scores, scores * (1 - blocked / 2))  # values may be negative
    return scores


def _mirrored(score: Callable[[jax.Array], jax.Array], image: jax.Array, axes: tuple[int, ...]) -> jax.Array:
    """Return the scores of the image mirrored along `axes`, each at the grasp that it mirrors."""
    scores = jnp.flip(score(jnp.flip(image, axes)), [axis + 1 for axis in axes])
    return scores[-np.arange(ROTATIONS) % ROTATIONS] if len(axes) == 1 else scores


def score_cells(
    network: GraspNet, image: Float[jax.Array, "224 224 4"], turns: int
) -> Float[jax.Array, "{turns} 80 80 16"]:
    """Return logits of the pixels of all cells of the first `turns` turned views; `compact` only.

    Images are turned and cut into cells by a table that is made once.
    """
    there, _ = turning_tables(turns)
    body: Any = network.body
    return body.cells(flat_pixels(image)[there].reshape(*there.shape[:3], -1))


def flat_pixels(image: Float[jax.Array, "H W 4"]) -> Float[jax.Array, "H*W+1 4"]:
    """Return the normalized pixels of an image as rows, and one more for the table (`turning_tables`)."""
    return jnp.concatenate([_normalized(image).reshape(-1, 4), jnp.zeros((1, 4))])


@functools.cache
def turning_tables(
    turns: int,
) -> tuple[Int[np.ndarray, "{turns} 80 80 16"], Int[np.ndarray, "{turns} 224 224"]]:
    """Return tables of indices that turn an image by each of the first `turns` angles, and turn scores back.

    Returns:
      For each pixel of each cell of the turned views, its pixel in the image (the one past the end is table); and for
      each pixel of each score map, its place in the logits of all cells.
    """
    side, cells = WORKSPACE.pixels, VIEW_PIXELS // CELL_PIXELS
    with jax.ensure_compile_time_eval():
        angles = jnp.asarray(grasp_angles()[:turns])
        image = jnp.arange(side**2).reshape(side, side)
        turned = jax.vmap(lambda a: geometry.rotate_map(image, a, VIEW_PIXELS, side**2))(angles)
        views = jnp.arange(turns * VIEW_PIXELS**2).reshape(turns, cells, cells, CELL_PIXELS, CELL_PIXELS)
        views = views.transpose(0, 1, 3, 2, 4).reshape(turns, VIEW_PIXELS, VIEW_PIXELS)
        back = jax.vmap(lambda v, a: geometry.unrotate_map(v, a, side))(views, angles)
        there = resnet.space_to_depth(turned[..., None], CELL_PIXELS)
    return np.asarray(there), np.asarray(back)
