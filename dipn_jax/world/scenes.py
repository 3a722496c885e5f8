"""Random clutter from a key, in mid-air or packed."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Key

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.structs import ABSENT, Array, Scene
from dipn_jax.world import packing, shapes
from dipn_jax.world.ranges import DEFAULT_RANGES, Ranges

PAPER_COUNTS = (0.02, 0.05, 0.2, 0.35, 0.3, 0.05, 0.03)
"""Probabilities of 1 to 7 objects in the push data. Source: DIPN's released code."""


MIN_SIDE = 0.025
"""Shortest side of an object in metres. The fingertips stop 20 mm above the table, and 2.5 mm of pad cannot hold a
box.
"""

NOMINAL_DENSITY = 500.0
"""Density in kg/m^3 where it is not known."""
NOMINAL_FRICTION = 0.35
"""Friction between object and table where it is not known."""


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """How random scenes are drawn.

    Example:
      config = dipn_jax.SceneConfig(slots=10, counts=(0.1,) * 10)   # 1 to 10 objects, all as likely
    """

    slots: int = 7  # padded number of objects
    counts: tuple[float, ...] = PAPER_COUNTS  # probability of 1, 2, ... objects
    ranges: Ranges = DEFAULT_RANGES
    spread: float = 0.24  # metres: side of the square the objects' centres are dropped in

    def __post_init__(self) -> None:
        if not 1 <= len(self.counts) <= self.slots:
            raise UserError(
                f"scene config: {len(self.counts)} object counts for {self.slots} slots; want 1 to {self.slots}"
            )
        if min(self.counts) < 0 or sum(self.counts) <= 0:
            raise UserError(f"scene config: counts {self.counts} are not probabilities; want non-negative, sum > 0")
        if self.ranges.packed and len(self.counts) > packing.MAX_OBJECTS:
            raise UserError(
                f"--packed with up to {len(self.counts)} objects: no more than {packing.MAX_OBJECTS} stand in rows; "
                "give fewer objects, or --packed 0"
            )


PAPER = SceneConfig()
"""The scenes of the push data, as published."""


def fixed_count(count: int, **changes: Any) -> SceneConfig:
    """Return a config with exactly `count` objects."""
    return SceneConfig(slots=count, counts=(0.0,) * (count - 1) + (1.0,), **changes)


def parse_objects(text: str, *, ranges: Ranges = DEFAULT_RANGES) -> SceneConfig:
    """Return the config for a number of objects given as text: `10`, `1:7` (uniform) or `paper` (PAPER_COUNTS).

    More than ten objects are dropped over a wider square, so that their tower is not too high to fall from.

    Raises:
      UserError: the text is none of these.
    """
    if text == "paper":
        return dataclasses.replace(PAPER, ranges=ranges)
    low, _, high = text.partition(":")
    try:
        first, last = int(low), int(high or low)
    except ValueError:
        raise UserError(f"--objects {text}: want a number, a range like 1:7, or paper") from None
    if not 1 <= first <= last <= 30:
        raise UserError(f"--objects {text}: want 1 to 30, smaller number first")
    counts = (0.0,) * (first - 1) + (1.0 / (last - first + 1),) * (last - first + 1)
    return SceneConfig(slots=last, counts=counts, ranges=ranges, spread=0.24 if last <= 10 else 0.30)


@functools.partial(jax.jit, static_argnames="config")
def random_scene(key: Key[Array, ""], *, config: SceneConfig) -> tuple[Scene, Float[jax.Array, "{config.slots} 7"]]:
    """Draw random objects in mid-air, none touching another; or packed (`Ranges.packed`).

    Args:
      key: random key.
      config: distributions.

    Returns:
      The scene, and poses: random positions and orientations, each object just above the
      bounding spheres of those before it, or rows of `packing`. Empty slots are parked outside the workspace.
    """
    n, ranges = config.slots, config.ranges
    keys = jax.random.split(key, 10)
    items = [i for i in shapes.CATALOGUE if not ranges.items or i.name in ranges.items]
    classes = jnp.array([shapes.CLASSES.index(i.shape) for i in items])
    nominal = jnp.array([i.size_mm for i in items], jnp.float32) / 1000
    count = 1 + jax.random.categorical(keys[0], jnp.log(jnp.array(config.counts)))
    present = jnp.arange(n) < count
    item = jax.random.randint(keys[1], (n,), 0, len(items))
    shape = jnp.where(present, classes[item], ABSENT)
    size = nominal[item] * jax.random.uniform(keys[2], (n, 3), minval=ranges.scale[0], maxval=ranges.scale[1])
    size = _allowed(size)
    colors = jnp.array(shapes.COLORS_RGB, jnp.float32) / 255
    palette = jax.random.permutation(keys[3], len(colors))
    noise = ranges.color_noise * jax.random.uniform(keys[8], (n, 3), minval=-1.0)
    color = jnp.clip(colors[palette[jnp.arange(n) % len(colors)]] + noise, 0.0, 1.0)
    density = jax.random.uniform(keys[4], (n,), minval=ranges.density[0], maxval=ranges.density[1])
    mass = density * jnp.asarray(shapes.UNIT_VOLUME, jnp.float32)[classes[item]] * size.prod(-1)
    friction = jax.random.uniform(keys[5], (n,), minval=ranges.friction[0], maxval=ranges.friction[1])
    xy = jax.random.uniform(keys[6], (n, 2), minval=-0.5, maxval=0.5) * config.spread
    quat = geometry.random_quat(keys[7], shape=(n,))
    radius = shapes.radius(shape, size)
    z = _stack_heights(xy, radius, present)
    poses = jnp.concatenate([xy, z[:, None], quat], -1)
    if ranges.packed:
        pack_key, which_key = jax.random.split(keys[9])
        rows = packing.pack(pack_key, shape, size, present)
        poses = jnp.where(jax.random.bernoulli(which_key, ranges.packed), rows, poses)
    poses = jnp.where(present[:, None], poses, parked(n))
    return Scene(shape.astype(jnp.int32), size, color, mass, friction), poses


def _allowed(size: Float[Array, "N 3"]) -> Float[jax.Array, "N 3"]:
    """Return sizes with no side under MIN_SIDE and the longest side cut where the diagonal is over MAX_DIAGONAL."""
    size = jnp.maximum(size, MIN_SIDE)
    longest = jnp.arange(3) == size.argmax(-1, keepdims=True)
    others = jnp.where(longest, 0.0, size**2).sum(-1, keepdims=True)
    limit = jnp.sqrt(jnp.maximum(shapes.MAX_DIAGONAL**2 - others, MIN_SIDE**2))
    return jnp.where(longest, jnp.minimum(size, limit), size)


def _stack_heights(
    xy: Float[Array, "N 2"], radius: Float[Array, " N"], present: Bool[Array, " N"]
) -> Float[jax.Array, " N"]:
    """Return the lowest heights at which spheres of `radius` over `xy` do not overlap, placed in order."""

    def place(heights: jax.Array, i: jax.Array) -> tuple[jax.Array, None]:
        gap = (xy - xy[i]) ** 2
        reach = (radius + radius[i] + 0.002) ** 2 - gap.sum(-1)
        before = (jnp.arange(len(radius)) < i) & present & (reach > 0)
        above = jnp.where(before, heights + jnp.sqrt(jnp.maximum(reach, 0.0)), 0.0)
        return heights.at[i].set(jnp.maximum(radius[i] + 0.005, above.max())), None

    heights, _ = jax.lax.scan(place, jnp.zeros_like(radius), jnp.arange(len(radius)))
    return heights


def parked(n: int) -> Float[jax.Array, "{n} 7"]:
    """Return the poses of empty slots: far outside the workspace, apart from one another."""
    x = 5.0 + 0.5 * jnp.arange(n, dtype=jnp.float32)
    zero, one = jnp.zeros(n), jnp.ones(n)
    return jnp.stack([x, zero + 5.0, zero + 1.0, one, zero, zero, zero], -1)


def remove(
    scene: Scene, poses: Float[Array, "*b N 7"], gone: Bool[Array, "*b N"]
) -> tuple[Scene, Float[jax.Array, "*b N 7"]]:
    """Return scenes and poses without the objects `gone`, which are parked."""
    shape = jnp.where(gone, ABSENT, scene.shape)
    return scene.replace(shape=shape), jnp.where(gone[..., None], parked(gone.shape[-1]), poses)


def nominal(scene: Scene) -> Scene:
    """Return scenes with guessed physics, as if only shapes were known: density 500 kg/m^3, friction 0.35."""
    shape = np.asarray(scene.shape)
    mass = np.where(shape >= 0, NOMINAL_DENSITY * shapes.volume(shape, np.asarray(scene.size)), 0.1)
    friction = np.full(shape.shape, NOMINAL_FRICTION, np.float32)
    return scene.replace(mass=mass.astype(np.float32), friction=friction)
