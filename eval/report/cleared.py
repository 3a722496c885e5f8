"""What a report reads from the folder of a `dipn-eval clear`."""

from __future__ import annotations

import pathlib
from typing import Any

from dipn_jax.errors import UserError
from dipn_jax.system import files, typed

from ..clearing import film, merging
from ..clearing.tables import SHIPPED
from . import conditions

COUNTS = ("instances", "grasps", "pushes")
"""Metrics that are numbers of something."""
_SETTINGS = {"method": str, "label": str, "tables.cases": str, "tables.objects": object} | conditions.FORM
"""Form of `settings.json`."""
_EPISODE = {name: form for name, form in merging.EPISODE.items() if name != "held"}
"""What a report reads of an entry of `episodes.json`."""


class Cleared:
    """The results in the folder of a `dipn-eval clear`."""

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        self.values = files.read_json(folder / "metrics.json", wanted={str: typed.Maybe(float)})
        files.read_json(folder / "metrics.json", wanted=dict.fromkeys(COUNTS, typed.Whole()))
        settings = files.read_json(folder / "settings.json", wanted=_SETTINGS)
        self.method, self.label = settings["method"], settings["label"]
        self.conditions = conditions.read(settings)
        packed = settings.get("tables.ranges", {}).get("packed") == 1
        self.tables = tables_name(settings["tables.cases"], settings["tables.objects"], packed=packed)
        self.episodes = files.read_json(folder / "episodes.json", wanted=[_EPISODE])
        if not self.episodes:
            raise UserError(f"{folder / 'episodes.json'}: lists no table; give a folder that dipn-eval clear wrote")

    def film(self, entry: dict[str, Any]) -> film.Film:
        """Return the film of a table that is listed.

        Raises:
          UserError: it is damaged, or listed under a name that leads out of the folder.
        """
        try:
            return film.load(typed.inside(self.folder, entry["file"]))
        except typed.Misfit as error:
            raise UserError(f"{self.folder / 'episodes.json'}: {error}; clear the tables again") from None

    @property
    def name(self) -> str:
        """The name of the method, with its label if it has one."""
        return f"{self.method} ({self.label})" if self.label else self.method

    @property
    def key(self) -> str:
        """Beginning of its metrics in a report: `clear/TABLES/METHOD`, or `clear/TABLES/LABEL/METHOD` with a label."""
        return "/".join(filter(None, ("clear", self.tables, self.label, self.method)))


def tables_name(cases: str, objects: str, *, packed: bool = False) -> str:
    """Return the name of a table of results: that of a case file, random-N or packed-N; `own-` sets a user's apart.

    Args:
      cases: as `--cases`.
      objects: number of objects on random tables, as `--objects`.
      packed: whether all random tables are packed.
    """
    if cases == "random":
        return f"{'packed' if packed else 'random'}-{objects}"
    stem = pathlib.Path(cases).stem
    taken = stem in SHIPPED or stem.startswith(("random-", "packed-"))
    return f"own-{stem}" if taken and cases not in SHIPPED else stem
