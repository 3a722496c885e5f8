"""The compared methods' networks: a value, or a chance, of every push and of every grasp (Zeng et al., IROS 2018)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float

from dipn_jax.errors import UserError
from dipn_jax.networks import resnet
from dipn_jax.networks.grasp import INPUT_SCALE, GraspConfig, GraspNet
from dipn_jax.sight import render

NETWORK_PARTS = ("push", "grasp")
"""Parts that a network may have, one for each primitive."""
GROWTH_RATE = 32
"""Channels that a layer of a DenseNet adds."""


@dataclasses.dataclass(frozen=True)
class VpgConfig:
    """Architecture. `paper`: two DenseNet-121 trunks a primitive; `compact`: GN's trunk for each."""

    preset: str = "compact"  # or paper
    parts: tuple[str, ...] = NETWORK_PARTS
    answers: str = "value"  # or chance: a probability
    blocks: tuple[int, ...] = (6, 12, 24, 16)  # paper: DenseNet-121
    width: int = 24  # compact: as GraspConfig
    coarse: int = 48  # compact: as GraspConfig

    def __post_init__(self) -> None:
        if self.preset not in ("paper", "compact"):
            raise UserError(f"VPG network: preset {self.preset!r}; want paper or compact")
        if not self.parts or set(self.parts) - set(NETWORK_PARTS):
            raise UserError(f"VPG network: parts {self.parts}; want push, grasp or both")
        if self.answers not in ("value", "chance"):
            raise UserError(f"VPG network: answers {self.answers!r}; want value or chance")


class _Layer(nnx.Module):
    """Dense layer: BN, ReLU, 1x1 to 4 GROWTH_RATE, BN, ReLU, 3x3 to GROWTH_RATE, after its input (Huang 2017)."""

    def __init__(self, features_in: int, rngs: nnx.Rngs) -> None:
        self.norms = nnx.List([nnx.BatchNorm(f, rngs=rngs) for f in (features_in, 4 * GROWTH_RATE)])
        self.reduce = resnet.conv(features_in, 4 * GROWTH_RATE, 1, rngs, bias=False)
        self.spatial = resnet.conv(4 * GROWTH_RATE, GROWTH_RATE, 3, rngs, bias=False)

    def __call__(self, x: Float[jax.Array, "B H W C"]) -> Float[jax.Array, "B H W G"]:
        y = self.reduce(nnx.relu(self.norms[0](x)))
        return jnp.concatenate([x, self.spatial(nnx.relu(self.norms[1](y)))], -1)


class DenseNet(nnx.Module):
    """The features of a DenseNet, at stride 32."""

    def __init__(self, blocks: tuple[int, ...], rngs: nnx.Rngs) -> None:
        self.stem = resnet.conv(3, 2 * GROWTH_RATE, 7, rngs, stride=2, bias=False)
        self.stem_norm = nnx.BatchNorm(2 * GROWTH_RATE, rngs=rngs)
        features, rows, norms, downs = 2 * GROWTH_RATE, [], [], []
        for i, count in enumerate(blocks):
            rows.append(nnx.List([_Layer(features + GROWTH_RATE * j, rngs) for j in range(count)]))
            features += GROWTH_RATE * count
            norms.append(nnx.BatchNorm(features, rngs=rngs))
            if i + 1 < len(blocks):
                downs.append(resnet.conv(features, features // 2, 1, rngs, bias=False))
                features //= 2
        self.blocks, self.norms, self.downs = nnx.List(rows), nnx.List(norms), nnx.List(downs)
        self.features = features

    def __call__(self, x: Float[jax.Array, "B H W 3"]) -> Float[jax.Array, "B h w {self.features}"]:
        x = resnet.max_pool(nnx.relu(self.stem_norm(self.stem(x))))
        for i, row in enumerate(self.blocks):
            for layer in row:
                x = layer(x)
            x = self.norms[i](x)
            if i < len(self.downs):
                x = nnx.avg_pool(self.downs[i](nnx.relu(x)), (2, 2), (2, 2))
        return x


class _Trunks(nnx.Module):
    """Colour and depth, each through its DenseNet at twice the resolution; a head of two 1x1 convolutions."""

    def __init__(self, config: VpgConfig, rngs: nnx.Rngs) -> None:
        self.config = config
        self.color, self.depth = DenseNet(config.blocks, rngs), DenseNet(config.blocks, rngs)
        both = 2 * self.color.features
        self.norms = nnx.List([nnx.BatchNorm(f, rngs=rngs) for f in (both, 64)])
        self.head = nnx.List([resnet.conv(both, 64, 1, rngs, bias=False), resnet.conv(64, 1, 1, rngs, bias=False)])

    def __call__(self, images: Float[jax.Array, "B H W 4"]) -> Float[jax.Array, "B H W"]:
        """Return a map of each image; sides divisible by 16."""
        b, h, w, _ = images.shape
        x = (images - jnp.array([*render.TABLE_COLOR, 0.0])) / jnp.array(INPUT_SCALE)
        x = jax.image.resize(x, (b, 2 * h, 2 * w, 4), "bilinear")
        y = jnp.concatenate([self.color(x[..., :3]), self.depth(jnp.repeat(x[..., 3:], 3, -1))], -1)
        for norm, conv in zip(self.norms, self.head, strict=True):
            y = conv(nnx.relu(norm(y)))
        return jax.image.resize(y.astype(jnp.float32), (b, h, w, 1), "bilinear")[..., 0]


class VPG(nnx.Module):
    """A map of pushes, a map of grasps, or both; as for GN, the view is turned by the action's angle."""

    def __init__(self, config: VpgConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config

        def part(name: str) -> nnx.Module:
            if name not in config.parts:
                return nnx.List([])
            if config.preset == "paper":
                return _Trunks(config, rngs)
            return GraspNet(GraspConfig(width=config.width, coarse=config.coarse), rngs=rngs)

        self.push, self.grasp = part("push"), part("grasp")
