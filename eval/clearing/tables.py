"""Which tables are cleared, options of `dipn-eval clear` and `sweep`. Importing this imports no JAX."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING

from dipn_jax import console, files
from dipn_jax.errors import UserError

if TYPE_CHECKING:
    from dipn_jax.engine import Engine

    from .instances import Instance


@dataclasses.dataclass(frozen=True)
class Tables:
    """Which tables are cleared."""

    cases: str = "hard"
    """hard (the ten hand-placed instances), random, or a case file of your own."""
    names: tuple[str, ...] = ()
    """Only these cases of the file."""
    objects: str = "10"
    """Number of objects (random): 10, 1:7 (uniform), or `paper`."""
    instances: int = 1
    """Tables (random), or repeats of each case with perturbed physics."""

    def __post_init__(self) -> None:
        console.require_positive(instances=self.instances)
        if self.names and self.cases == "random":
            raise UserError("--names: random tables have none; give --cases hard or a case file")

    def path(self) -> pathlib.Path | None:
        """Return the case file; None for random tables."""
        from dipn_jax.world import cases as case_files

        if self.cases == "random":
            return None
        return case_files.hard_cases_path() if self.cases == "hard" else files.absolute(self.cases)

    def slots(self) -> int:
        """Return the largest number of objects on one of the tables."""
        from dipn_jax.world import cases as case_files
        from dipn_jax.world import scenes

        path = self.path()
        if path is None:
            return scenes.parse_objects(self.objects).slots
        return int(case_files.load_cases(path)[1].shape.shape[1])

    def make(self, engine: Engine, *, seed: int) -> list[Instance]:
        """Make all tables, at rest."""
        from dipn_jax.world import scenes

        from .instances import hard_instances, random_instances

        path = self.path()
        if path is None:
            config = scenes.parse_objects(self.objects)
            return random_instances(engine, config, count=self.instances, seed=seed)
        return hard_instances(
            engine, path, list(self.names) or None, slots=self.slots(), repeats=self.instances, seed=seed
        )


DEFAULT_TABLES = Tables()
"""The tables that are cleared unless told otherwise."""
