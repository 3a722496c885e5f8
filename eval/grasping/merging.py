"""One evaluation of grasps from the parts of several workers."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from dipn_jax.errors import UserError
from dipn_jax.storage import arrays
from dipn_jax.system import files, typed

from .. import curves, drawing
from ..clearing import merging as clearing
from ..clearing.instances import Instance
from ..clearing.lockstep import Outcome
from ..workers.shares import PART, Part
from . import rates
from .rates import Arrays

TRIED = "tried.npz"
"""Name of the file with what was tried."""
_ORDERS = ("table", "random_table", "missed_table", "single_scene")
"""Arrays by which the others, whose names begin alike, are in order."""


def save(out: pathlib.Path, found: Arrays) -> None:
    """Write what was tried on the tables of a part."""
    files.write_atomically(out / TRIED, arrays.dumps({name: found[name] for name in rates.FORMS}))


def pooled(parts: Sequence[Part]) -> Arrays:
    """Return what was tried in all parts, in the order of the tables.

    Raises:
      UserError: a part is damaged.
    """
    found = []
    for part in parts:
        try:
            found.append(arrays.read(part.path(TRIED), rates.FORMS))
        except typed.Misfit as error:
            raise UserError(f"{part.folder / TRIED}: damaged, {error}; {part.advice()}") from None
    joined = {name: np.concatenate([each[name] for each in found]) for name in rates.FORMS}
    for order in _ORDERS:
        size = rates.FORMS[order].shape
        places = np.argsort(joined[order], kind="stable")
        joined |= {name: joined[name][places] for name, form in rates.FORMS.items() if form.shape == size}
    return joined


def merge(parts: Sequence[Part], out: pathlib.Path) -> dict[str, Any]:
    """Write what `dipn-eval grasp` writes beside its metrics, and return these."""
    part = parts[0]
    try:
        about = typed.check(part.about, {"others": typed.Whole(), "online": typed.Maybe({str: float})})
    except typed.Misfit as error:
        raise UserError(f"{part.folder / PART}: damaged, {error}; {part.advice()}") from None
    found, tables = pooled(parts), clearing.tables(parts, out)
    return finish(out, found, tables, others=about["others"], online=about["online"])


def finish(
    out: pathlib.Path,
    found: Arrays,
    tables: Sequence[Outcome] | Sequence[Instance],
    *,
    others: int,
    online: dict[str, Any] | None,
) -> dict[str, Any]:
    """Draw the figure of all tables, and return the metrics.

    Args:
      out: folder of the results.
      found: what was tried.
      tables: how they ended.
      others: grasps that were tried after each miss.
      online: metrics of runs that learnt while grasping; None if none were given.
    """
    alone = rates.label_rates(found)
    values = (online or {}) | rates.rates(found, tables, others=others)
    values |= {f"labels_of_single_objects/{key}": value for key, value in alone.items()}
    drawing.write(rates.reliability_figure(values), out / "reliability.png")
    if online is not None:
        drawing.write(curves.grasp_figure(values), out / "curve.png")
    return values
