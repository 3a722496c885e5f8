"""DIPN: where does every object go when the gripper pushes?

Everything the network sees is in the push frame: moved by the rigid transform T that takes the start to
pixel (40, 112) and the direction to +x.
"""

from __future__ import annotations

import dataclasses
import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import candidates, geometry, losses
from dipn_jax.errors import UserError
from dipn_jax.networks import resnet
from dipn_jax.structs import ABSENT, Push, Pytree
from dipn_jax.workspace import GRIPPER, WORKSPACE

START_PIXEL = (40.0, 112.0)  # col, row of the start in the push frame
START_BOX = (40, 100, 65, 124)  # M_p: col, row of the corners of the white box
CROP = 60  # pixels of an object's mask about its centre


@dataclasses.dataclass(frozen=True)
class DipnConfig:
    """Architecture. `paper` is as published; `compact` trains on a laptop's CPU."""

    preset: str = "compact"
    stages: tuple[int, ...] = (3, 4, 6, 3)  # paper: ResNet-50; the released code has (2, 2, 2, 2)
    width: int = 32  # compact: channels of the first stage
    map_stride: int = 2  # compact: the maps are sampled every so many pixels

    def __post_init__(self) -> None:
        if self.preset not in ("paper", "compact"):
            raise UserError(f"push network: preset {self.preset!r}; want paper or compact")

    @property
    def stride(self) -> int:
        """Pixels between samples of the inputs."""
        return 1 if self.preset == "paper" else self.map_stride


@flax.struct.dataclass
class PushInput(Pytree):
    """What DIPN sees of one push, in the push frame. `s` is `DipnConfig.stride`."""

    push_map: jax.Array  # [224/s, 224/s] float: M_p (paper) or the swept rectangle (compact)
    scene_map: jax.Array  # [224/s, 224/s] float: M_I, 1 on any object
    crops: jax.Array  # [N, 60/s, 60/s, 3] float: M_i about c_i; the other objects; the push map
    centers: jax.Array  # [N, 2] c_i, metres from the start, push frame
    present: jax.Array  # [N] bool: objects in sight
    push: jax.Array  # [4] start and end in the push frame, in units of the map's side


def _sweep(xy: jax.Array, distance: jax.Array) -> jax.Array:
    """1 where the closed gripper passes; `xy [..., 2]` metres from the start, push frame."""
    inside = (xy[..., 0] >= -GRIPPER.pad_width / 2) & (xy[..., 0] <= distance + GRIPPER.pad_width / 2)
    return (inside & (jnp.abs(xy[..., 1]) <= GRIPPER.push_width / 2)).astype(jnp.float32)


def push_input(label: jax.Array, push: Push, *, slots: int, stride: int) -> tuple[PushInput, jax.Array]:
    """Move a label map into the frame of one push.

    Args:
      label: `[224, 224]` int32.
      push: one push.
      slots: N.
      stride: pixels between samples.

    Returns:
      The network's input, and the mask centroids `[N, 2]` in the workspace (metres).
    """
    centers, area = candidates.mask_centers(label, slots)
    start_offset = np.array(START_PIXEL, np.float32)

    def to_workspace(local: jax.Array) -> jax.Array:
        return geometry.rotate2d(local, push.angle) + push.start

    side = WORKSPACE.pixels // stride
    pixel = geometry.view_grid(side, side) * stride + stride // 2  # the push's axis falls between two rows
    local = (pixel - start_offset) * WORKSPACE.pixel
    seen = geometry.sample_nearest(label, geometry.metres_to_pixels(to_workspace(local)), ABSENT)
    if stride == 1:
        col0, row0, col1, row1 = START_BOX
        col, row = pixel[..., 0], pixel[..., 1]
        box = (col >= col0) & (col <= col1) & (row >= row0) & (row <= row1)
        push_map = box.astype(jnp.float32)
    else:
        push_map = _sweep(local, push.distance)
    local_centers = geometry.rotate2d(centers - push.start, -push.angle)
    crop_side = CROP // stride
    crop_pixel = (geometry.view_grid(crop_side, crop_side) - (crop_side - 1) / 2) * stride * WORKSPACE.pixel
    crop_local = local_centers[:, None, None] + crop_pixel
    crop = geometry.sample_nearest(label, geometry.metres_to_pixels(to_workspace(crop_local)), ABSENT)
    own = crop == jnp.arange(slots)[:, None, None]
    other = (crop != ABSENT) & ~own
    crops = jnp.stack([own, other, _sweep(crop_local, push.distance)], -1).astype(jnp.float32)
    origin = start_offset / WORKSPACE.pixels
    end = jnp.array([origin[0] + push.distance / WORKSPACE.side, origin[1]])
    inputs = PushInput(
        push_map,
        (seen != ABSENT).astype(jnp.float32),
        crops,
        local_centers,
        area > 0,
        jnp.concatenate([jnp.asarray(origin), end]),
    )
    return inputs, centers


def mirror(inputs: PushInput) -> PushInput:
    """The same push seen in a mirror that holds its axis (batched or not).

    Row 112 of the map is the axis and has no counterpart for row 0: the maps are rolled by what the
    flip shifts them.
    """
    axis = inputs.scene_map.ndim - 2
    stride = WORKSPACE.pixels // inputs.scene_map.shape[axis]
    shift = 1 if stride == 1 else 0
    flip = lambda m: jnp.roll(jnp.flip(m, axis), shift, axis)  # noqa: E731
    return inputs.replace(
        push_map=flip(inputs.push_map),
        scene_map=flip(inputs.scene_map),
        crops=jnp.flip(inputs.crops, -3),
        centers=inputs.centers * jnp.array([1.0, -1.0]),
    )


class _Interaction(nnx.Module):
    """MLP3, MLP4 and MLP5: direct and pairwise effects, summed, with the global feature, to a motion."""

    def __init__(self, push: int, item: int, scene: int, rngs: nnx.Rngs) -> None:
        self.direct = resnet.MLP(push + item, (128, 128), rngs)
        self.pair = resnet.MLP(push + 2 * item, (128, 128, 128), rngs)
        self.motion = resnet.MLP(scene + 128, (256, 64, 32, 16, 3), rngs, linear_end=True)

    def __call__(self, e_push: jax.Array, e_item: jax.Array, e_scene: jax.Array, present: jax.Array) -> jax.Array:
        b, n, _ = e_item.shape
        push = jnp.broadcast_to(e_push[:, None], (b, n, e_push.shape[-1]))
        direct = self.direct(jnp.concatenate([push, e_item], -1))
        shape = (b, n, n)
        pair = jnp.concatenate(
            [
                jnp.broadcast_to(e_push[:, None, None], (*shape, e_push.shape[-1])),
                jnp.broadcast_to(e_item[:, :, None], (*shape, e_item.shape[-1])),
                jnp.broadcast_to(e_item[:, None, :], (*shape, e_item.shape[-1])),
            ],
            -1,
        )
        others = present[:, None, :, None] & ~jnp.eye(n, dtype=bool)[None, :, :, None]
        total = direct + jnp.where(others, self.pair(pair), 0.0).sum(2)
        scene = jnp.broadcast_to(e_scene[:, None], (b, n, e_scene.shape[-1]))
        return self.motion(jnp.concatenate([scene, total], -1))


class _PaperEncoders(nnx.Module):
    """ResNet1 on (M_p, M_I) to 512 numbers, ResNet2 on M_i to 64."""

    def __init__(self, config: DipnConfig, rngs: nnx.Rngs) -> None:
        self.scene = resnet.ResNet(2, config.stages, rngs)
        self.scene_out = nnx.Linear(2048, 512, rngs=rngs)
        self.item = resnet.ResNet(1, config.stages, rngs)
        self.item_out = nnx.Linear(2048, 64, rngs=rngs)
        self.sizes = (512, 64)

    def __call__(self, maps: jax.Array, crops: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
        scene = self.scene_out(self.scene(maps)[-1].mean((1, 2)))
        item = self.item_out(self.item(crops[..., :1], present)[-1].mean((1, 2)))
        return scene, item


class _CompactEncoder(nnx.Module):
    """Pixels folded into channels, then three small stages; the last map is read out in place, not averaged."""

    def __init__(self, features_in: int, fold: int, width: int, side: int, out: int, rngs: nnx.Rngs) -> None:
        self.fold = fold
        self.stem = resnet.conv(features_in * fold**2, width, 3, rngs)
        self.block1 = resnet.PlainBlock(width, rngs)
        self.down2 = resnet.conv(width, 2 * width, 3, rngs, stride=2)
        self.block2 = resnet.PlainBlock(2 * width, rngs)
        self.down3 = resnet.conv(2 * width, 2 * width, 3, rngs, stride=2)
        half = lambda s: (s + 1) // 2  # noqa: E731
        self.out = nnx.Linear(half(half(side // fold)) ** 2 * 2 * width, out, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        x = self.block1(nnx.relu(self.stem(resnet.space_to_depth(x, self.fold))))
        x = self.block2(nnx.relu(self.down2(x)))
        x = nnx.relu(self.down3(x))
        return nnx.relu(self.out(x.reshape(x.shape[0], -1)))


class _CompactEncoders(nnx.Module):
    """Both maps to 128 numbers; a crop with its surroundings and the sweep to 128."""

    def __init__(self, config: DipnConfig, rngs: nnx.Rngs) -> None:
        side = WORKSPACE.pixels // config.stride
        self.scene = _CompactEncoder(2, 8, config.width, side, 128, rngs)
        self.item = _CompactEncoder(3, 3, config.width, CROP // config.stride, 128, rngs)
        self.sizes = (128, 128)

    def __call__(self, maps: jax.Array, crops: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
        del present  # no batch statistics
        return self.scene(maps), self.item(crops)


class DIPN(nnx.Module):
    """Deep Interaction Prediction Network (Huang et al., ICRA 2021)."""

    def __init__(self, config: DipnConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        make = _PaperEncoders if config.preset == "paper" else _CompactEncoders
        self.encoders = make(config, rngs)
        scene, item = self.encoders.sizes
        self.push = resnet.MLP(4, (8, 16), rngs)
        self.center = resnet.MLP(2, (8, 16), rngs)
        self.interaction = _Interaction(16, item + 16, scene, rngs)

    def __call__(self, inputs: PushInput) -> jax.Array:
        """Motions of every object.

        Args:
          inputs: batched, `[B, ...]`.

        Returns:
          `[B, N, 3]`: dx, dy in pixels and dtheta in degrees, push frame; 0 for objects out of sight.
        """
        b, n = inputs.present.shape
        maps = jnp.stack([inputs.push_map, inputs.scene_map], -1)
        crops = inputs.crops.reshape(b * n, *inputs.crops.shape[2:])
        scene, item = self.encoders(maps, crops, inputs.present.reshape(-1))
        where = self.center(inputs.centers / (WORKSPACE.half / 2))
        e_item = jnp.concatenate([item.reshape(b, n, -1), where], -1)
        motion = self.interaction(self.push(inputs.push), e_item, scene, inputs.present)
        return jnp.where(inputs.present[..., None], motion, 0.0)


@functools.partial(jax.jit, static_argnames=("slots", "stride"))
def push_inputs(labels: jax.Array, pushes: Push, *, slots: int, stride: int) -> tuple[PushInput, jax.Array]:
    """`push_input` over a batch: labels `[B, 224, 224]`, pushes `[B]`."""
    return jax.vmap(functools.partial(push_input, slots=slots, stride=stride))(labels, pushes)


def to_workspace(motion: jax.Array, angle: jax.Array) -> jax.Array:
    """Network output `[..., N, 3]` (pixels, degrees, push frame) to metres and radians, workspace; `angle [...]`."""
    metric = motion / losses.PIXELS_DEGREES
    shift = geometry.rotate2d(metric[..., :2], angle[..., None])
    return jnp.concatenate([shift, metric[..., 2:]], -1)


def from_workspace(motion: jax.Array, angle: jax.Array) -> jax.Array:
    """Inverse of `to_workspace`."""
    shift = geometry.rotate2d(motion[..., :2], -angle[..., None])
    return jnp.concatenate([shift, motion[..., 2:]], -1) * losses.PIXELS_DEGREES
