"""The ranges that random objects are drawn from, options of the commands. Importing this imports no JAX."""

from __future__ import annotations

import dataclasses
from typing import Annotated, TypeAlias

import tyro

from dipn_jax.errors import UserError

Objects = Annotated[str, tyro.conf.arg(help="How many: 10, 1:7 (uniform), or `paper` (1 to 7, as published).")]
"""Number of objects in a scene, an option of the commands; `scenes.parse_objects` reads it."""
Range: TypeAlias = tuple[float, float]
"""Smallest and largest value."""
BOUNDS = {"scale": (0.5, 1.2), "density": (10.0, 25_000.0), "friction": (0.01, 5.0)}
"""Smallest and largest value allowed in each range, by what camera and fingers allow; densities of cork to platinum."""


@dataclasses.dataclass(frozen=True)
class Ranges:
    """The ranges that random objects are drawn from uniformly."""

    items: tuple[str, ...] = ()
    """Names from the catalogue (`shapes.CATALOGUE`); none given: all of them."""
    scale: Range = (0.9, 1.03)
    """Factor of each nominal dimension; no side is thinner than 25 mm, no diagonal longer than 126 mm."""
    density: Range = (250.0, 750.0)
    """Density of objects in kg/m^3."""
    friction: Range = (0.28, 0.42)
    """Sliding coefficient between object and table; between objects it is 0.5 / 0.35 of the larger of two."""
    color_noise: float = 0.0
    """Largest difference of each colour channel, in [0, 1], from the palette."""
    packed: float = 0.0
    """Share of scenes whose objects are not dropped but stand side by side in rows."""

    def __post_init__(self) -> None:
        for name, (least, most) in BOUNDS.items():
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise UserError(f"--{name} {low:g} {high:g}: want two numbers from {least:g} to {most:g}, in order")
        for name in ("color_noise", "packed"):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f"--{name.replace('_', '-')} {getattr(self, name):g}: want 0 to 1")
        if self.items:
            _require_in_catalogue(self.items)


DEFAULT_RANGES = Ranges()
"""The default ranges."""


def _require_in_catalogue(items: tuple[str, ...]) -> None:
    from dipn_jax.world import shapes

    names = [item.name for item in shapes.CATALOGUE]
    if len(set(items)) < len(items):
        raise UserError(f"--items {' '.join(items)}: want none twice")
    unknown = [name for name in items if name not in names]
    if unknown:
        raise UserError(f"--items {' '.join(unknown)}: not in the catalogue; choose from {' '.join(sorted(names))}")
