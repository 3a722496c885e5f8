"""One evaluation of cleared tables from the parts of several workers."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

from dipn_jax.errors import UserError
from dipn_jax.system import files, typed

from ..workers.shares import Part
from . import lockstep
from .lockstep import EPISODES, Outcome

EPISODE = {
    "name": str,
    "file": str,
    "ended": {"cleared", "pushed out", "out of actions", "fault"},
    "objects": typed.Whole(1),
    "removed": typed.Whole(),
    "held": typed.Whole(),
    "grasps": typed.Whole(),
    "pushes": typed.Whole(),
}
"""Form of an entry of `episodes.json`."""


def tables(parts: Sequence[Part], out: pathlib.Path) -> list[Outcome]:
    """Copy the films of all parts, write their list, and return how the tables ended, in order.

    Args:
      parts: all of an evaluation.
      out: folder of the whole one.

    Raises:
      UserError: a part is damaged.
    """
    listed: dict[int, tuple[Part, dict[str, Any]]] = {}
    for part in parts:
        lines = files.read_json(part.path(EPISODES), wanted=[EPISODE])
        if len(lines) != len(part.rows()):
            raise UserError(f"{part.folder / EPISODES}: {len(lines)} tables, want {len(part.rows())}; {part.advice()}")
        listed |= {row: (part, line) for row, line in zip(part.rows(), lines, strict=True)}
    ordered = [listed[row] for row in sorted(listed)]
    for part, line in ordered:
        files.write_atomically(typed.inside(out, line["file"]), files.read_bytes(part.path(line["file"])))
    files.write_json(out / EPISODES, [line for _, line in ordered])
    counted = [name for name in EPISODE if name != "file"]
    return [Outcome(**{name: line[name] for name in counted}) for _, line in ordered]


def merge(parts: Sequence[Part], out: pathlib.Path) -> dict[str, Any]:
    """Write what `dipn-eval clear` writes beside its metrics, and return these."""
    return lockstep.summary(tables(parts, out))
