"""The figures of docs/push-prediction.md: `python docs/push_prediction.py RESULTS` after the commands on that page.

Gathers RESULTS/{curve,alone-*,shift-*,with-*,without-*,crowd-*}/metrics.json in docs/push-prediction.json; copies
figures, prints tables.
"""

from __future__ import annotations

import pathlib
import shutil
import sys
from typing import Any

from dipn_jax.eval import curves

from dipn_jax import console, files
from dipn_jax.world import shapes

DOCS = pathlib.Path(__file__).parent
SHIFTS = {
    "shift-none": "as trained on",
    "shift-heavier": "density 1,000 to 1,500 kg/m³ (250 to 750)",
    "shift-lighter": "density 100 to 200 kg/m³",
    "shift-slipperier": "friction 0.1 to 0.2 (0.28 to 0.42)",
    "shift-stickier": "friction 0.5 to 0.7",
    "shift-crowded": "8 to 15 objects (1 to 7)",
}
COLUMNS = [(f"{c}cm", which) for c in curves.DISTANCES for which in ("all", "moved")]


def shift_table(values: dict[str, Any]) -> str:
    """Builtin network, floor and better baseline where the world is not what the network learnt from."""
    titles = [f"{at}, {which}" for at, which in COLUMNS]
    lines = ["| scenes | predictor | " + " | ".join(titles) + " |", "| --- " * (len(titles) + 2) + "|"]
    for shift, title in SHIFTS.items():
        for name in ("dipn", "physics", "trans"):
            keys = [f"{shift}/push_error/{name}/{at}/{which}" for at, which in COLUMNS]
            if all(key in values for key in keys):
                cells = [f"{values[key]:.3f}" for key in keys]
                lines.append(f"| {title} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def alone_table(values: dict[str, Any]) -> str:
    """One network for every distance against one for each, and one taught by found masks; 1,500 pushes, seed 0."""
    names = {"every": "one network for 1 to 10 cm", "only5": "trained for 5 cm", "only10": "trained for 10 cm"}
    names["found"] = "1 to 10 cm, trained on masks found in the image"
    columns = [(f"push_error{masks}", at, which) for masks in ("", "_segmented") for at, which in COLUMNS]
    titles = [f"{at}, {which}{', found masks' * measure.endswith('segmented')}" for measure, at, which in columns]
    lines = ["| network | " + " | ".join(titles) + " |", "| --- " * (len(titles) + 1) + "|"]
    for name, title in names.items():
        cells = []
        for measure, at, which in columns:
            asked = not name.startswith("only") or at == f"{name.removeprefix('only')}cm"
            cells.append(f"{values[f'alone-{name}/{measure}/dipn/{at}/{which}']:.3f}" if asked else "")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def unseen_table(values: dict[str, Any]) -> str:
    """Scenes of one class of shapes only: a network never shown that class, and one shown all; 1,500 pushes each."""
    titles = [f"{at}, {which}" for at, which in COLUMNS]
    lines = ["| shapes | predictor | " + " | ".join(titles) + " |", "| --- " * (len(titles) + 2) + "|"]
    predictors = {
        "DIPN, never shown them": ("without", "dipn"),
        "DIPN, shown all": ("with", "dipn"),
        "`physics`": ("without", "physics"),
        "`trans`": ("without", "trans"),
    }
    for name in shapes.CLASSES:
        for title, (folder, predictor) in predictors.items():
            keys = [f"{folder}-{name}/push_error/{predictor}/{at}/{which}" for at, which in COLUMNS]
            cells = [f"{values[key]:.3f}" for key in keys]
            lines.append(f"| {name.replace('_', ' ')} | {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def crowd_table(values: dict[str, Any]) -> str:
    """Scenes of 8 to 15 objects: networks trained on such scenes, and on 1 to 7."""
    titles = [f"{at}, {which}" for at, which in COLUMNS]
    lines = ["| trained on | " + " | ".join(titles) + " |", "| --- " * (len(titles) + 1) + "|"]
    trained = {
        "crowd-few": "1,500 pushes, 1 to 7 objects",
        "crowd-crowded": "1,500 pushes, 8 to 15 objects",
        "shift-crowded": "51,000 pushes, 1 to 7 objects",
    }
    for folder, title in trained.items():
        cells = [f"{values[f'{folder}/push_error/dipn/{at}/{which}']:.3f}" for at, which in COLUMNS]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


GOALS = [
    ("1,500 pushes, 1 - IoU, all objects", "push_error/curve/1500/{}/all/mean", False, (0.10, 0.16)),
    ("1,500 pushes, XOR / 2 true, all objects", "push_error_paper_measure/curve/1500/{}/all/mean", False, (0.06, 0.10)),
    ("51,000 pushes, 1 - IoU, all objects", "push_error/curve/51000/{}/all/mean", False, (0.05, 0.08)),
    (
        "1,500 pushes, 1 - IoU over a baseline's, moved",
        "push_error/curve/1500/{}/moved/mean",
        True,
        (0.35, 0.40),
    ),
    (
        "51,000 pushes, 1 - IoU over a baseline's, moved",
        "push_error/curve/51000/{}/moved/mean",
        True,
        (0.35, 0.40),
    ),
]


def goal_table(values: dict[str, Any]) -> str:
    """What was wanted and what came."""
    lines = ["| figure | 5 cm, goal | 5 cm | 10 cm, goal | 10 cm |", "| --- | --- | --- | --- | --- |"]
    for title, key, over, goals in GOALS:
        cells = []
        for at, goal in zip(("5cm", "10cm"), goals, strict=True):
            level = min(values[f"push_error/{name}/{at}/moved"] for name in ("trans", "static")) if over else 1.0
            cells += [f"<= {goal:.2f}", f"{values[key.format(at)] / level:.3f}"]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def tables(values: dict[str, Any]) -> list[str]:
    """All tables of the page."""
    pages = [curves.push_table(values, which=which) for which in ("all", "moved")]
    return [
        goal_table(values),
        *pages,
        alone_table(values),
        shift_table(values),
        unseen_table(values),
        crowd_table(values),
    ]


def main() -> None:
    """Entry point."""
    results = pathlib.Path(sys.argv[1])
    values = files.read_json(results / "curve" / "metrics.json")
    found_in = ("alone", "shift", "with", "without", "crowd")
    for folder in sorted(each for name in found_in for each in results.glob(f"{name}-*")):
        found = files.read_json(folder / "metrics.json")
        values |= {f"{folder.name}/{key}": value for key, value in found.items() if key.startswith("push_")}
    files.write_json(DOCS / "push-prediction.json", values)
    for which in ("all", "moved"):
        shutil.copy(results / "curve" / f"curve-{which}.png", DOCS / f"push-prediction-{which}.png")
    for table in tables(values):
        console.say(table)


if __name__ == "__main__":
    main()
