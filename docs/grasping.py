"""The figures of docs/grasping.md: `python docs/grasping.py RESULTS` after the commands on that page.

Gathers RESULTS/{online,builtin-*,unseen-*}/metrics.json in docs/grasping.json; copies figures, prints tables.
"""

from __future__ import annotations

import pathlib
import shutil
import sys
from typing import Any

from dipn_jax.eval import curves

from dipn_jax import console, files

DOCS = pathlib.Path(__file__).parent
COUNTS = (50, 100, 200, 300, 400)
ROWS = {
    "builtin-10": "10 objects",
    "builtin-30": "30 objects",
    "unseen-concave": "10 arches, never trained on",
}
RATES = {"gn": "GN, until the table is empty", "gn_first": "GN, first grasp", "random_foreground": "random foreground"}


def success_table(values: dict[str, Any]) -> str:
    """Success of the network that comes with the package, with 95 % intervals, and what physics allows."""
    titles = [*RATES.values(), "tables", "grasps", "tables emptied", "ceiling", "ECE"]
    lines = ["| | " + " | ".join(titles) + " |", "| --- " * (len(titles) + 1) + "|"]
    for row, title in ROWS.items():
        if f"{row}/attempts" not in values:
            continue
        cells = []
        for name in RATES:
            value, low, high = (100 * values[f"{row}/grasp_success/{name}{end}"] for end in ("", "_low", "_high"))
            cells.append(f"{value:.1f} [{low:.1f}, {high:.1f}] %")
        cells += [str(values[f"{row}/{key}"]) for key in ("scenes", "attempts", "table/ended_cleared")]
        ceiling = values.get(f"{row}/other_grasps/ceiling")
        cells += ["" if ceiling is None else f"{100 * ceiling:.1f} %"]
        cells += [f"{values[f'{row}/expected_calibration_error']:.3f}"]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def label_table(values: dict[str, Any]) -> str:
    """How far the labels of pre-training agree with physics, single objects."""
    at = "builtin-10/labels_of_single_objects"
    lines = ["| random grasps | agree | positives that hold | negatives that fail |", "| --- | --- | --- | --- |"]
    shares = [f"{100 * values[f'{at}/{key}']:.0f} %" for key in ("agree", "positive_holds", "negative_fails")]
    return "\n".join([*lines, f"| {values[f'{at}/grasps']} | " + " | ".join(shares) + " |"]) + "\n"


def tables(values: dict[str, Any]) -> list[str]:
    """All tables of the page."""
    return [success_table(values), curves.grasp_table(values, COUNTS), label_table(values)]


def main() -> None:
    """Entry point."""
    results = pathlib.Path(sys.argv[1])
    values = files.read_json(results / "online" / "metrics.json")
    for row in ROWS:
        path = results / row / "metrics.json"
        if path.exists():
            values |= {f"{row}/{key}": value for key, value in files.read_json(path).items()}
    files.write_json(DOCS / "grasping.json", values)
    shutil.copy(results / "online" / "curve.png", DOCS / "grasping-online.png")
    shutil.copy(results / "builtin-10" / "reliability.png", DOCS / "grasping-reliability.png")
    for table in tables(values):
        console.say(table)


if __name__ == "__main__":
    main()
