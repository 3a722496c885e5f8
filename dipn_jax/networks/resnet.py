"""Residual trunks: the published ResNet-50, and small ones without normalization for CPUs."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Bool, Float, Shaped

SMALL_MAP = 2
"""Pixels along a side of a map up to which a convolution is written as one matrix product."""


class Conv(nnx.Conv):
    """An `nnx.Conv` that keeps the resolution, in the form that XLA differentiates fastest on a CPU.

    Measured forward and backward on two cores: a 1x1 as a matrix product is 1.5 to 6 times as fast, a 3x3 of 512
    channels on 56 maps of 2x2 pixels 70 times, an 11x57 of one channel 10 times.
    """

    def __call__(  # type: ignore[override]
        self, x: Float[jax.Array, "B H W C"]
    ) -> Float[jax.Array, "B h w {self.out_features}"]:
        """Convolve maps, to a resolution lower by the stride; computed in the layer's `dtype`, as any layer of Flax."""
        bias: jax.Array | float = 0.0
        if self.bias is None:
            x, kernel = self.promote_dtype((x, self.kernel[...]), dtype=self.dtype)
        else:
            x, kernel, bias = self.promote_dtype((x, self.kernel[...], self.bias[...]), dtype=self.dtype)
        size, step = kernel.shape[0], self.strides[0]  # type: ignore[index]
        if kernel.shape[:2] == (1, 1):
            return x[:, ::step, ::step] @ kernel[0, 0] + bias
        if kernel.shape[2:] == (1, 1) and step == 1:
            return _banded(x[..., 0], kernel[..., 0, 0])[..., None] + bias
        if size == kernel.shape[1] and max(x.shape[1:3]) <= SMALL_MAP * step:
            return _patches(x, size, step) @ kernel.reshape(-1, kernel.shape[-1]) + bias
        return super().__call__(x)


def _banded(x: Float[jax.Array, "B H W"], kernel: Float[jax.Array, "rows cols"]) -> Float[jax.Array, "B H W"]:
    """Convolve maps of one channel with a kernel of odd sides, by a matrix product for each of its rows."""
    (rows, cols), (height, width) = kernel.shape, x.shape[1:]
    offset = np.arange(width)[:, None] - np.arange(width) + cols // 2
    inside = (offset >= 0) & (offset < cols)
    bands = jnp.where(inside, kernel[:, np.clip(offset, 0, cols - 1)], 0.0)
    x = jnp.pad(x, ((0, 0), (rows // 2, rows // 2), (0, 0)))
    return sum(x[:, i : i + height] @ bands[i] for i in range(rows))  # type: ignore[return-value]


def _patches(x: Float[jax.Array, "B H W C"], size: int, step: int) -> Float[jax.Array, "B h w {size}**2*C"]:
    """Return every `size` x `size` neighbourhood of a map, at a resolution lower by `step`, flattened."""
    rows, cols = (side + 2 * (size // 2) - size + 1 for side in x.shape[1:3])
    edge = (size // 2, size // 2)
    x = jnp.pad(x, ((0, 0), edge, edge, (0, 0)))
    shifted = [x[:, i : i + rows : step, j : j + cols : step] for i in range(size) for j in range(size)]
    return jnp.concatenate(shifted, -1)


def max_pool(x: Float[jax.Array, "B H W C"]) -> Float[jax.Array, "B h w C"]:
    """Return the largest of 3 x 3 at stride 2; written out, because XLA differentiates `nnx.max_pool` slowly on a CPU.

    It takes 12 times as long.
    """
    for axis in (1, 2):
        edges = [(0, 0)] * 4
        edges[axis] = (1, 1)
        padded, count = jnp.pad(x, edges, constant_values=-jnp.inf), x.shape[axis]
        near = [jax.lax.slice_in_dim(padded, i, i + count, 2, axis) for i in range(3)]
        x = functools.reduce(jnp.maximum, near)
    return x


def conv(
    features_in: int, features: int, size: int | tuple[int, int], rngs: nnx.Rngs, *, stride: int = 1, bias: bool = True
) -> Conv:
    """Return a `size` x `size` convolution, padded to keep the resolution (over `stride`)."""
    kernel = (size, size) if isinstance(size, int) else size
    pad = tuple((k // 2, k // 2) for k in kernel)  # a tuple: graph definitions are hashed
    return Conv(features_in, features, kernel, strides=(stride, stride), padding=pad, use_bias=bias, rngs=rngs)


class Bottleneck(nnx.Module):
    """1x1, 3x3, 1x1 with batch normalization (He et al. 2016); the stride sits in the 3x3."""

    def __init__(self, features_in: int, width: int, stride: int, rngs: nnx.Rngs) -> None:
        out = 4 * width
        self.reduce = conv(features_in, width, 1, rngs, bias=False)
        self.spatial = conv(width, width, 3, rngs, stride=stride, bias=False)
        self.expand = conv(width, out, 1, rngs, bias=False)
        self.norms = nnx.List([nnx.BatchNorm(f, rngs=rngs) for f in (width, width, out)])
        self.project: nnx.List = nnx.List([])  # empty where the input can be added as it is
        if stride != 1 or features_in != out:
            self.project = nnx.List(
                [conv(features_in, out, 1, rngs, stride=stride, bias=False), nnx.BatchNorm(out, rngs=rngs)]
            )

    def __call__(
        self, x: Float[jax.Array, "B H W C"], mask: Bool[jax.Array, "B 1 1 1"] | None = None
    ) -> Float[jax.Array, "B h w F"]:
        y = nnx.relu(self.norms[0](self.reduce(x), mask=mask))
        y = nnx.relu(self.norms[1](self.spatial(y), mask=mask))
        y = self.norms[2](self.expand(y), mask=mask)
        if self.project:
            x = self.project[1](self.project[0](x), mask=mask)
        return nnx.relu(x + y)


class ResNet(nnx.Module):
    """Bottleneck ResNet; `stages=(3, 4, 6, 3)` is ResNet-50.

    Returns the four stages' maps at strides 4, 8, 16, 32 with 256, 512, 1024 and 2048 channels. `mask`
    leaves images out of the batch statistics.
    """

    def __init__(self, features_in: int, stages: Sequence[int], rngs: nnx.Rngs) -> None:
        self.stem = conv(features_in, 64, 7, rngs, stride=2, bias=False)
        self.stem_norm = nnx.BatchNorm(64, rngs=rngs)
        blocks, features = [], 64
        for stage, count in enumerate(stages):
            width = 64 * 2**stage
            row = []
            for i in range(count):
                row.append(Bottleneck(features, width, 2 if stage > 0 and i == 0 else 1, rngs))
                features = 4 * width
            blocks.append(nnx.List(row))
        self.blocks = nnx.List(blocks)

    def __call__(self, x: Float[jax.Array, "B H W C"], mask: Bool[jax.Array, " B"] | None = None) -> list[jax.Array]:
        mask = None if mask is None else mask[:, None, None, None]
        x = nnx.relu(self.stem_norm(self.stem(x), mask=mask))
        x = max_pool(x)
        maps = []
        for row in self.blocks:
            for block in row:
                x = block(x, mask)
            maps.append(x)
        return maps


class PlainBlock(nnx.Module):
    """Two 3x3 convolutions with a residual that starts at zero, so that it needs no normalization."""

    def __init__(self, features: int, rngs: nnx.Rngs) -> None:
        self.first = conv(features, features, 3, rngs)
        zero = functools.partial(Conv, kernel_init=nnx.initializers.zeros)
        self.second = zero(features, features, (3, 3), strides=(1, 1), padding="SAME", rngs=rngs)

    def __call__(self, x: Float[jax.Array, "B H W C"]) -> Float[jax.Array, "B H W C"]:
        return nnx.relu(x + self.second(nnx.relu(self.first(x))))


class MLP(nnx.Module):
    """Dense layers of the given sizes with ReLU between (and after, unless `linear_end`)."""

    def __init__(self, features_in: int, sizes: Sequence[int], rngs: nnx.Rngs, *, linear_end: bool = False) -> None:
        layers, features = [], features_in
        for size in sizes:
            layers.append(nnx.Linear(features, size, rngs=rngs))
            features = size
        self.layers = nnx.List(layers)
        self.linear_end = linear_end

    def __call__(self, x: Float[jax.Array, "*b F"]) -> Float[jax.Array, "*b G"]:
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i + 1 < len(self.layers) or not self.linear_end:
                x = nnx.relu(x)
        return x


def space_to_depth(
    x: Shaped[jax.Array, "B H W C"], block: int
) -> Shaped[jax.Array, "B H//{block} W//{block} {block}**2*C"]:
    """Fold blocks of pixels into channels."""
    b, h, w, c = x.shape
    x = x.reshape(b, h // block, block, w // block, block, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(b, h // block, w // block, block * block * c)


def depth_to_space(
    x: Shaped[jax.Array, "B H W C"], block: int
) -> Shaped[jax.Array, "B H*{block} W*{block} C//{block}**2"]:
    """Return the inverse of `space_to_depth`."""
    b, h, w, c = x.shape
    x = x.reshape(b, h, w, block, block, c // block**2).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(b, h * block, w * block, c // block**2)


def upsample2(x: Float[jax.Array, "B H W C"]) -> Float[jax.Array, "B 2*H 2*W C"]:
    """Double the resolution of maps by repeating pixels."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
