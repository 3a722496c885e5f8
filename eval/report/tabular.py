"""The tables of results without the page: as Markdown to read, and as CSV to compute with."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import markdown

from . import paper
from .cleared import COUNTS
from .results import DIFFERENCE, ENDS, MEASURES, NOTE, Results

COLUMNS = (
    *("source", "tables", "method", "label", *COUNTS),
    *(f"{measure}{end}" for measure in MEASURES for end in ENDS),
    *("against", *(f"{DIFFERENCE}{end}" for end in ENDS)),
)
"""Columns of the CSV: counts, and shares as in `metrics.json`."""


def as_markdown(found: Sequence[Results]) -> str:
    """Return the tables with what is said below them, in Markdown; per cent, as on the page."""
    parts = []
    for each in found:
        head, lines = each.cells()
        table = markdown.table([_plain(cell) for cell in head], [[_plain(cell) for cell in line] for line in lines])
        notes = "".join(f"\n{_plain(note)}\n" for note in each.notes())
        parts.append(f"## {_plain(each.tables)}\n\n{table}{notes}\n")
    return f"{''.join(parts)}{NOTE}\n"


def _plain(text: str) -> str:
    """Return a text on one line in which no character is markup."""
    return re.sub(r"([\\`*<>|$~]|\](?=[(\[]))", r"\\\1", " ".join(text.split()))


def as_csv(found: Sequence[Results]) -> str:
    """Return the tables as one, with a line for each row and the names of COLUMNS above them.

    Numbers are shares, not per cent, and not rounded; empty where nothing is known. `source` is `here`, or `paper` for
    the numbers of the paper.
    """
    lines: list[dict[str, Any]] = []
    for each in found:
        for one in each.rows:
            named = {"source": "here", "tables": each.tables, "method": one.method, "label": one.label}
            line = {name: value for name, value in one.values.items() if name in COLUMNS} | named
            if one.name in each.differences and each.rival is not None:
                line["against"] = each.rival.name
            lines.append(line | each.difference_of(one))
        for method, numbers in each.published.items():
            shares = {name: f"{number / 100:.4g}" for name, number in zip(paper.COLUMNS, numbers, strict=True)}
            lines.append({"source": "paper", "tables": each.tables, "method": method} | shares)
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()
