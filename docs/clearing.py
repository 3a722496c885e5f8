"""The figures of docs/clearing.md: `python docs/clearing.py RESULTS` after the commands on that page.

Gathers RESULTS/*/metrics.json of `dipn-eval clear` in docs/clearing.json, and prints the tables.
"""

from __future__ import annotations

import pathlib
import sys
from typing import Any

from dipn_jax import console, files
from eval import comparison, paper

DOCS = pathlib.Path(__file__).parent
TITLES = {
    "completion": "completion",
    "grasp_success_completed": "grasp success, completed",
    "grasp_success_all": "all",
    "efficiency_completed": "efficiency, completed",
    "efficiency_all": "all",
}


def _cell(values: dict[str, Any], at: str) -> str:
    value, low, high = (values.get(f"{at}{end}") for end in ("", "_low", "_high"))
    return "-" if value is None else f"{100 * value:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def table(values: dict[str, Any], tables: str) -> str:
    """All methods on one kind of tables, %, and the paper's numbers of the same."""
    heads = [f"| {tables} | tables | pushes | " + " | ".join(TITLES.values()) + " |"]
    lines = [*heads, "| --- " * (len(TITLES) + 3) + "|"]
    for at in sorted({key.rpartition("/")[0] for key in values if key.startswith(f"clear/{tables}/")}):
        name = ", ".join(reversed(at.split("/")[2:]))
        cells = [str(values[f"{at}/instances"]), str(values[f"{at}/pushes"])]
        cells += [_cell(values, f"{at}/{key}") for key in TITLES]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for method, numbers in paper.TABLE.get(tables, {}).items():
        lines.append(f"| *{method}, the paper* | | | " + " | ".join(f"{number:.1f}" for number in numbers) + " |")
    return "\n".join(lines) + "\n"


def tables(values: dict[str, Any]) -> list[str]:
    """All tables of the page."""
    return [table(values, kind) for kind in sorted({key.split("/")[1] for key in values})]


def main() -> None:
    """Entry point."""
    folders = sorted(path.parent for path in pathlib.Path(sys.argv[1]).glob("*/metrics.json"))
    values = comparison.flat([comparison.Cleared(folder) for folder in folders])
    files.write_json(DOCS / "clearing.json", values)
    for each in tables(values):
        console.say(each)


if __name__ == "__main__":
    main()
