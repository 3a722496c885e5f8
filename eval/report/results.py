"""The table of results of each kind of tables, beside the paper's, with differences that are paired by table."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dipn_jax.errors import UserError

from .. import drawing, metrics
from . import conditions, paper
from .cleared import COUNTS, Cleared

MEASURES = ("completion", "grasps_that_held", *paper.COLUMNS[1:])
"""Metrics of the table of results: those of the paper, and a share that no grasp of two objects raises."""
COMPARED = "efficiency_all"
"""Metric whose differences are reported: objects per action."""
DIFFERENCE = f"{COMPARED}_difference"
"""Name of its difference."""

ENDS = ("", "_low", "_high")
"""Ends of the names of a metric and of its interval."""
NOTE = (
    "Per cent, with 95 % intervals over cases, then over their repeats (random tables: over tables): of a bootstrap, "
    "or the binomial's where nothing failed. The numbers of the paper are of its own simulator, robot and objects."
)
"""What is said below the tables of results."""
Difference = tuple[float, float, float]
"""A difference of two shares, and the ends of its interval."""


@dataclasses.dataclass(frozen=True)
class Results:
    """The rows of one table of results."""

    rows: Sequence[Cleared]  # on tables of the same name, at least one
    rival: Cleared | None = None  # the row that the others are compared with
    against: str = ""  # what the user called it

    @property
    def tables(self) -> str:
        """The name of the tables."""
        return self.rows[0].tables

    @property
    def published(self) -> Mapping[str, tuple[float, ...]]:
        """The paper's numbers on these tables, per cent, by method."""
        return paper.TABLE.get(self.tables, {})

    @functools.cached_property
    def differences(self) -> dict[str, Difference | None]:
        """How much larger the objects per action of every other row are than the rival's, as shares, by name of row.

        Difference, low, high: NaN where nothing is known, such as the interval of a single table; None where the row is
        of other tables than the rival, or of tables of which too little was recorded to tell.
        """
        found: dict[str, Difference | None] = {}
        for one in self.rows:
            if self.rival is None or one is self.rival:
                continue
            cases = [entry["name"] for entry in one.episodes]
            found[one.name] = None
            if _paired(one, self.rival):
                sides = _removed_and_actions(one), _removed_and_actions(self.rival)
                value, *interval = metrics.ratio_difference(*sides, cases)
                low, high = interval if len(cases) > 1 else (float("nan"), float("nan"))
                found[one.name] = (value, low, high)
        return found

    def difference_of(self, one: Cleared) -> dict[str, float | None]:
        """Return a row's difference from the rival as metrics, None where nothing is known; empty for the rival."""
        if one.name not in self.differences:
            return {}
        parts = self.differences[one.name] or (None, None, None)
        return {
            f"{DIFFERENCE}{end}": value if value is not None and np.isfinite(value) else None
            for end, value in zip(ENDS, parts, strict=True)
        }

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Return the titles of the columns and the cells of the rows, as text, per cent."""
        head = ["", "tables", "grasps", "pushes", *[f"{measure.replace('_', ' ')} %" for measure in MEASURES]]
        lines = []
        for one in self.rows:
            counts = [str(one.values[key]) for key in COUNTS]
            lines.append([one.name, *counts, *[drawing.percent(one.values, key) for key in MEASURES]])
        for method, numbers in self.published.items():
            known = dict(zip(paper.COLUMNS, numbers, strict=True))
            shares = [f"{known[key]:.1f}" if key in known else "" for key in MEASURES]
            lines.append([f"{method}, the paper", "", "", "", *shares])
        if self.rival is not None:
            head.append(f"{COMPARED.replace('_', ' ')}, points from {self.rival.name}")
            told = [_told(self.differences[one.name]) if one is not self.rival else "" for one in self.rows]
            told += [""] * len(self.published)
            lines = [[*line, last] for line, last in zip(lines, told, strict=True)]
        return head, lines

    def notes(self) -> list[str]:
        """Return what is said below the table: how its rows were made, in what they differ, and what is compared."""
        found = conditions.notes({one.name: one.conditions for one in self.rows})
        if self.rival is not None and self.differences:
            found.append(
                f"Points from {self.rival.name}: objects per action minus those of {self.rival.name}, in percentage "
                "points, paired by table, with a 95 % interval; ahead and behind stand where it excludes zero."
            )
            if unpaired := [name for name, difference in self.differences.items() if difference is None]:
                found.append(f"Of other tables than {self.rival.name}, so not compared: {', '.join(unpaired)}.")
        elif self.against and self.rival is None:
            found.append(f"No row here is {self.against}, so nothing is compared.")
        return found


def grouped(all_cleared: Sequence[Cleared], *, against: str = "") -> list[Results]:
    """Return the tables of results, one for each kind of tables, in the order of the folders.

    Args:
      all_cleared: rows of all of them.
      against: the row that the others are compared with: a method, a label, or both as the report shows them.

    Raises:
      UserError: no row is called so, or several of the same tables are.
    """
    groups: dict[str, list[Cleared]] = {}
    for one in all_cleared:
        groups.setdefault(one.tables, []).append(one)
    found = [Results(rows, _called(rows, against) if against else None, against) for rows in groups.values()]
    if against and all(each.rival is None for each in found):
        names = dict.fromkeys(one.name for one in all_cleared)
        raise UserError(f"--against {against}: no row is called so; want one of: {', '.join(names)}")
    return found


def _called(rows: Sequence[Cleared], against: str) -> Cleared | None:
    """Return the row that is called so in full; otherwise the only one with this method or label."""
    for one in rows:
        if one.name == against:
            return one
    some = [one for one in rows if against in (one.method, one.label)]
    if len(some) > 1:
        names = ", ".join(one.name for one in some)
        raise UserError(f"--against {against}: on {rows[0].tables} these are called so: {names}; give one in full")
    return some[0] if some else None


def _paired(one: Cleared, other: Cleared) -> bool:
    """Return whether two rows are known to be of the same tables, table by table."""
    tables = [[(entry["name"], entry["objects"]) for entry in row.episodes] for row in (one, other)]
    return one.conditions.same_tables(other.conditions) and tables[0] == tables[1]


def differences(found: Sequence[Results]) -> dict[str, float | None]:
    """Return the differences from the rivals as metrics of a report."""
    return {
        f"{one.key}/{name}": value
        for each in found
        for one in each.rows
        for name, value in each.difference_of(one).items()
    }


def _removed_and_actions(one: Cleared) -> tuple[Any, Any]:
    """Return objects removed and actions of each table `[I]`."""
    removed, grasps, pushes = (
        np.array([entry[name] for entry in one.episodes]) for name in ("removed", "grasps", "pushes")
    )
    return removed, grasps + pushes


def _told(difference: Difference | None) -> str:
    """Return a difference in percentage points, with a word where its interval excludes zero."""
    if difference is None or not np.isfinite(difference[0]):
        return "-"
    value, low, high = (100 * part for part in difference)
    interval = f" [{low:+.1f}, {high:+.1f}]" if np.isfinite(low) else ""
    return f"{value:+.1f}{interval}{'' if low == high else ' ahead' if low > 0 else ' behind' if high < 0 else ''}"
