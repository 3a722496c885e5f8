"""One evaluation of predictions from the parts of several workers."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dipn_jax.errors import UserError
from dipn_jax.storage import arrays
from dipn_jax.storage.arrays import Form
from dipn_jax.system import files, typed

from .. import curves, drawing
from ..workers import shares
from ..workers.shares import PART, Part
from . import push_errors
from .push_errors import DISTANCES

ERRORS = "errors.npz"
"""Name of the file with the errors of every push."""
FILMS = "films.npz"
"""Name of the file with pictures of some pushes."""


def save(out: pathlib.Path, rows: Mapping[str, np.ndarray], films: Mapping[str, np.ndarray]) -> list[str]:
    """Write what was measured for a part, and return the names of the files."""
    files.write_atomically(out / ERRORS, arrays.dumps(rows))
    if not films:
        return [ERRORS]
    save_films(out, films)
    return [ERRORS, FILMS]


def save_films(out: pathlib.Path, films: Mapping[str, np.ndarray]) -> None:
    """Write the pictures of some pushes."""
    files.write_atomically(out / FILMS, arrays.dumps(films))


def _form(name: str) -> Form:
    return Form("iu", ("B",)) if name == "group" else Form("fb", ("B", len(DISTANCES), "N"))


def pooled(parts: Sequence[Part], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the errors of all parts, in the order of their groups.

    Raises:
      UserError: a part is damaged.
    """
    return shares.pooled(parts, ERRORS, {name: _form(name) for name in names}, by="group")


def merge(parts: Sequence[Part], out: pathlib.Path) -> dict[str, Any]:
    """Write what `dipn-eval prediction` writes beside its metrics, and return these."""
    first = parts[0]
    try:
        about = typed.check(first.about, {"arrays": [str], "compared": [str]})
        if not {"group", "visible", "moved"} <= set(about["arrays"]):
            raise typed.Misfit("arrays are missing")
    except typed.Misfit as error:
        raise UserError(f"{first.folder / PART}: damaged, {error}; {first.advice()}") from None
    rows = pooled(parts, about["arrays"])
    files.write_atomically(out / FILMS, files.read_bytes(first.path(FILMS)))
    try:
        return finish(out, rows, about["compared"])
    except KeyError as error:
        raise UserError(f"{first.folder / PART}: damaged, {error} is missing; {first.advice()}") from None


def finish(out: pathlib.Path, rows: Mapping[str, np.ndarray], compared: Sequence[str]) -> dict[str, Any]:
    """Return the metrics of all pushes; draw the learning curve where there is one.

    Args:
      out: folder of the results.
      rows: errors of all pushes, as `push_errors.measured` returns them.
      compared: names of the networks of a learning curve.
    """
    values = push_errors.summary(rows)
    kept = {key: value for key, value in values.items() if not any(f"/{name}/" in key for name in compared)}
    values = kept | curves.push_summary(values, compared)
    for which in ("all", "moved") if compared else ():
        drawing.write(curves.push_figure(values, which=which), out / f"curve-{which}.png")
        files.write_text(out / f"curve-{which}.md", curves.push_table(values, which=which))
    return values
