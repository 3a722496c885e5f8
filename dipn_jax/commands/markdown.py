"""Tables in Markdown, as reports and pages of results have them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of a row of titles and rows of cells; it ends with a newline."""
    lines = (head, ["---"] * len(head), *rows)
    return "".join("| " + " | ".join(cells).lstrip() + " |\n" for cells in lines)
