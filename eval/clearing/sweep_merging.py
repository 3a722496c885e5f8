"""One sweep over push distances from the parts of several workers.

A part of a sweep has a folder for each distance, which is a part of what `dipn-eval clear` makes there.
"""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from dipn_jax.errors import UserError
from dipn_jax.storage import arrays
from dipn_jax.storage.arrays import Form
from dipn_jax.system import files, typed

from .. import drawing, metrics
from ..workers import shares
from ..workers.shares import PART, Part
from . import merging, sweeping

ERRORS = "errors.npz"
"""Name of the file with the errors of predictions."""


def save(out: pathlib.Path, names: Sequence[str], errors: dict[str, np.ndarray] | None) -> list[str]:
    """Write the errors of predictions of a part, and return the names of its files, those of all distances included.

    Args:
      out: folder of the part.
      names: of what was swept.
      errors: as `sweeping.measured` returns them; None where they are not asked for.
    """
    found = [f"{name}/{file}" for name in names for file in (PART, *shares.read(out / name).files)]
    if errors is None:
        return found
    files.write_atomically(out / ERRORS, arrays.dumps(errors))
    return [ERRORS, *found]


def _pooled(parts: Sequence[Part], distances: int) -> dict[str, np.ndarray]:
    """Return the errors of predictions of all parts, in the order of their scenes.

    Raises:
      UserError: a part is damaged.
    """
    size = ("B", distances, 2)
    forms = {"scene": Form("iu", ("B",)), "error": Form("f", size), "count": Form("iu", size)}
    return shares.pooled(parts, ERRORS, forms, by="scene")


def merge(parts: Sequence[Part], out: pathlib.Path) -> dict[str, Any]:
    """Write what `dipn-eval sweep` writes beside its metrics, and return these."""
    first = parts[0]
    try:
        about = typed.check(first.about, {"names": [str], "errors": bool})
    except typed.Misfit as error:
        raise UserError(
            f"{first.folder / PART}: damaged, or of one distance only ({error}); give the folder of the whole part"
        ) from None
    values: dict[str, Any] = {}
    for name in about["names"]:
        each = [shares.read(part.path(f"{name}/{PART}").parent) for part in parts]
        found = merging.merge(each, out / name)
        metrics.write(out / name, found, settings=each[0].settings | {"out": str(out / name)})
        values |= {f"sweep/{name}/{key}": value for key, value in found.items()}
    errors = _pooled(parts, len(about["names"]) - 1) if about["errors"] else None
    return finish(out, values, errors, about["names"])


def finish(
    out: pathlib.Path, values: dict[str, Any], errors: dict[str, np.ndarray] | None, names: Sequence[str]
) -> dict[str, Any]:
    """Draw the sweep, and return its metrics.

    Args:
      out: folder of the results.
      values: metrics of clearing.
      errors: of predictions, of all scenes; None where they are not asked for.
      names: of what was swept, the choosing policy last.
    """
    if errors is not None:
        values = values | sweeping.error_rates(errors, names[:-1])
    drawing.write(sweeping.figure(values), out / "sweep.png")
    return values
