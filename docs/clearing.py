"""The figures of docs/clearing.md: `python docs/clearing.py RESULTS SWEEP` after the commands on that page.

Gathers RESULTS/*/metrics.json of `dipn-eval clear` in docs/clearing.json and SWEEP/metrics.json of `dipn-eval sweep` in
docs/sweep.json, and prints the tables.
"""

from __future__ import annotations

import pathlib
import sys
from typing import Any

from dipn_jax.eval.clearing import sweeping
from dipn_jax.eval.report import comparison, paper

from dipn_jax import console, files

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


def swept(values: dict[str, Any]) -> str:
    """What `dipn-eval sweep` found at each distance, %; prediction errors are true 1-IoU of objects that move."""
    lines = ["| push | error, moved objects | completion | grasp success | efficiency | pushes |", "| --- " * 6 + "|"]
    for each in sweeping.names(values):
        at = f"sweep/{each}"
        error = values.get(f"{at}/push_error/moved")
        name = each if error is None else f"{100 * float(each):.0f} cm"
        cells = [_cell(values, f"{at}/{key}") for key in sweeping.SHOWN]
        lines.append(
            f"| {name} | {'-' if error is None else f'{error:.3f}'} | {' | '.join(cells)} | {values[f'{at}/pushes']} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Entry point."""
    folders = sorted(path.parent for path in pathlib.Path(sys.argv[1]).glob("*/metrics.json"))
    values = comparison.flat([comparison.Cleared(folder) for folder in folders])
    files.write_json(DOCS / "clearing.json", values)
    sweep = files.read_json(pathlib.Path(sys.argv[2]) / "metrics.json")
    files.write_json(DOCS / "sweep.json", {key: value for key, value in sweep.items() if key.startswith("sweep/")})
    for each in (*tables(values), swept(sweep)):
        console.say(each)


if __name__ == "__main__":
    main()
