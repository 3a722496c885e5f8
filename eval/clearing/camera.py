"""What a policy sees of simulated tables: masks, and noise of the camera. Importing this imports no JAX."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
from typing import TYPE_CHECKING, Any, Literal

from dipn_jax.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from dipn_jax.structs import Array, Observation, Scene

HOLE_RADII = (1, 2, 3, 4)
"""Radii in pixels of the spots in which the camera sees no depth."""
BOUNDS = {"height_noise": 0.02, "holes": 0.5, "image_noise": 0.5}
"""Largest value allowed of each kind of noise."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """What the camera gives the policy: which masks, and how much noise."""

    masks: Literal["found", "true"] = "found"
    """found: cut out of the image by colour and height, as from a camera; true: the simulator's."""
    height_noise: float = 0.0
    """Standard deviation of the noise of each pixel's height, metres."""
    holes: float = 0.0
    """Share of the pixels without depth, in round spots; they take the height of the nearest pixel that has one."""
    image_noise: float = 0.0
    """Standard deviation of the noise of each pixel's red, green and blue, which are in [0, 1]."""

    def __post_init__(self) -> None:
        for name, most in BOUNDS.items():
            if not 0 <= getattr(self, name) <= most:
                raise UserError(f"--{name.replace('_', '-')} {getattr(self, name):g}: want 0 to {most:g}")

    @property
    def noisy(self) -> bool:
        """Whether the image differs from the simulator's."""
        return bool(self.height_noise or self.holes or self.image_noise)

    def look(self, keys: Any, scene: Scene, poses: Array) -> Observation:
        """Return what is seen of tables.

        Args:
          keys: `[B]` random keys, of the noise.
          scene: `[B, N]`.
          poses: `[B, N, 7]`.

        Returns:
          Observations `[B]`, NumPy. Found masks are numbered by size, not as the objects of the scene.
        """
        import jax
        import numpy as np

        from dipn_jax import physics
        from dipn_jax.sight import render, segment

        seen: Observation = jax.device_get(render.observe(scene, poses))
        if self.noisy:
            seeds = np.asarray(jax.random.key_data(keys))
            noisy = [
                self._disturb(np.random.default_rng(list(seed)), *pair)
                for seed, *pair in zip(seeds, seen.height, seen.color, strict=True)
            ]
            seen = seen.replace(height=np.stack([one[0] for one in noisy]), color=np.stack([one[1] for one in noisy]))
        if self.masks == "true":
            return seen
        found = functools.partial(segment.segment, slots=seen.slots)
        with concurrent.futures.ThreadPoolExecutor(physics.cores()) as pool:
            return seen.replace(label=np.stack(list(pool.map(found, seen.height, seen.color))))

    def _disturb(
        self, rng: np.random.Generator, height: np.ndarray, color: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return height and colour of one image with noise."""
        import numpy as np

        height = height + rng.normal(0, self.height_noise, height.shape)
        color = np.clip(color + rng.normal(0, self.image_noise, color.shape), 0, 1)
        return filled(height, spots(rng, height.shape, self.holes)).astype(np.float32), color.astype(np.float32)


def spots(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> np.ndarray:
    """Return random round spots `[H, W]` bool that cover about `share` of the pixels."""
    import cv2
    import numpy as np

    drawn = np.zeros(shape, np.uint8)
    area = np.mean([np.pi * radius**2 for radius in HOLE_RADII])
    for _ in range(round(-np.log1p(-share) * drawn.size / area)):  # spots overlap: 1 - exp(-count area / size)
        row, col = rng.integers(0, shape)
        cv2.circle(drawn, (int(col), int(row)), int(rng.choice(HOLE_RADII)), 1, -1)
    return drawn.astype(bool)


def filled(height: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Return a height map `[H, W]` in which each of the `holes` has the height of the nearest pixel outside them."""
    from scipy import ndimage

    rows, cols = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    return height[rows, cols]


DEFAULT_CAMERA = Camera()
"""Masks found in an image without noise."""
