"""Which tables are cleared, options of `dipn-eval clear` and `sweep`. Importing this imports no JAX."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files
from dipn_jax.world.ranges import DEFAULT_RANGES, Ranges

from .. import options

if TYPE_CHECKING:
    from dipn_jax.engine import Engine

    from .instances import Instance

SHIPPED = ("hard", "heldout")
"""Case files that come with the package."""


@dataclasses.dataclass(frozen=True)
class Tables:
    """Which tables are cleared."""

    cases: str = "hard"
    """hard (ten hand-placed cases), heldout (fifteen, on which no setting was tuned), random, or a case file."""
    names: tuple[str, ...] = ()
    """Only these cases of the file."""
    objects: str = "10"
    """Number of objects (random): 10, 1:7 (uniform), or `paper`."""
    instances: int = 1
    """Tables (random), or repeats of each case, each with other masses and frictions and moved by up to 2 mm."""
    as_placed: bool = False
    """Take cases as they are placed, once each: nothing is perturbed."""
    ranges: Ranges = DEFAULT_RANGES
    """The ranges that random objects are drawn from."""

    def __post_init__(self) -> None:
        console.require_between(1, options.MOST_TABLES, instances=self.instances)
        if len(set(self.names)) < len(self.names):
            raise UserError(f"--names {' '.join(self.names)}: want none twice; give --instances for repeats")
        if self.names and self.cases == "random":
            raise UserError("--names: random tables have none; give --cases hard or a case file")
        if self.as_placed and (self.cases == "random" or self.instances > 1):
            raise UserError("--as-placed: for cases, once each; give no --cases random and no --instances")
        if self.ranges != DEFAULT_RANGES and self.cases != "random":
            raise UserError("--items, --scale, --density, --friction, --color-noise, --packed: for --cases random only")

    def path(self) -> pathlib.Path | None:
        """Return the case file; None for random tables."""
        from dipn_jax.world import cases as case_files

        if self.cases == "random":
            return None
        if self.cases in SHIPPED:
            return case_files.hard_cases_path() if self.cases == "hard" else case_files.heldout_cases_path()
        return files.absolute(self.cases)

    def slots(self) -> int:
        """Return the largest number of objects on one of the tables."""
        from dipn_jax.world import cases as case_files
        from dipn_jax.world import scenes

        path = self.path()
        if path is None:
            return scenes.parse_objects(self.objects, ranges=self.ranges).slots
        return int(case_files.load_cases(path)[1].shape.shape[1])

    def count(self) -> int:
        """Return the number of tables; nothing is simulated."""
        from dipn_jax.world import cases as case_files

        path = self.path()
        if path is None:
            return self.instances
        return self.instances * len(self.names or case_files.load_cases(path)[0])

    def make(self, engine: Engine, *, seed: int) -> list[Instance]:
        """Make all tables, at rest."""
        from dipn_jax.world import scenes

        from .instances import case_instances, random_instances

        path = self.path()
        if path is None:
            config = scenes.parse_objects(self.objects, ranges=self.ranges)
            return random_instances(engine, config, count=self.instances, seed=seed)
        return case_instances(
            engine,
            path,
            list(self.names) or None,
            slots=self.slots(),
            repeats=self.instances,
            seed=seed,
            perturbed=not self.as_placed,
        )


DEFAULT_TABLES = Tables()
"""The tables that are cleared by default."""
