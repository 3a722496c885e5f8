"""The networks that were measured: which step of which run, and the digest of its weights."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator

from dipn_jax.commands import pages
from dipn_jax.system import files, typed

DIGITS = 12
"""Digits of a digest that the report shows; `settings.json` has all of them."""
_FORM = {"method?": str, "label?": str, "networks?": {str: typed.Maybe({"step": typed.Whole(), "digest": str})}}
"""What is read of `settings.json`."""


def table(folders: dict[pathlib.Path, str]) -> str:
    """Return an HTML table of the networks measured by the evaluations in folders, with a dash where none is recorded.

    Args:
      folders: each with the name of what was evaluated, for those that record no method.

    Raises:
      UserError: the settings of one are damaged.
    """
    head = ["method", "label", "network", "step", f"digest (first {DIGITS} digits)"]
    return pages.table(head, [row for folder, name in folders.items() for row in _rows(folder, name)])


def _rows(folder: pathlib.Path, name: str) -> Iterator[list[str]]:
    """Yield the cells of the rows of an evaluation."""
    path = folder / "settings.json"
    settings = files.read_json(path, wanted=_FORM) if path.exists() else {}
    told = [settings.get("method", name), settings.get("label") or "-"]
    found = settings.get("networks") or {"-": None}
    for run, used in found.items():
        step, digest = (str(used["step"]), used["digest"][:DIGITS]) if used else ("-", "-")
        yield [*told, _named(pathlib.Path(run)), step, digest]


def _named(run: pathlib.Path) -> str:
    """Return the name of a run, also where one step of it was given."""
    return run.parents[1].name if run.parent.name == "checkpoints" else run.name
