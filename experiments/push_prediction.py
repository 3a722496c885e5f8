"""Push prediction: the learning curves and all other results on docs/push-prediction.md.

    python -m experiments.push_prediction          # or make push-figures

Hours on 2 cores. It can be interrupted; the same command continues. The network that comes with the package is the run
`runs/51000-0`, exported:

    dipn-train export --run results/push/runs/51000-0 --out dipn_jax/data/dipn
"""

from __future__ import annotations

import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Any

from dipn_jax.eval import curves

from dipn_jax.commands import markdown
from dipn_jax.system import files
from dipn_jax.world import shapes
from experiments import command, pages
from experiments.runs import Recipe, Run

STEPS = {100: 600, 300: 1000, 500: 1500, 1000: 2500, 1500: 3000, 51000: 10000}
"""Optimizer steps of the learning curve, by number of pushes in the training data."""

TRAIN = "push --eval-every 1000 --save-every 1000 --data"
"""Start of a training command, without its program; a folder of pushes follows."""

TRAIN_1500 = f"dipn-train {TRAIN.replace('--data', '--limit 1500 --steps 3000 --data')}"
"""Start of a training command on 1,500 pushes; a folder of pushes follows."""

ITEMS = {
    "cuboid": "cuboid_half cuboid_flat cuboid_long cube cuboid_mid cuboid_square",
    "cylinder": "cylinder cylinder_flat",
    "half_cylinder": "half_cylinder half_cylinder_large",
    "triangular_prism": "triangle triangle_flat",
    "concave": "concave concave_slim",
}
"""Items of the catalogue by class of shapes."""


def list_runs(root: pathlib.Path) -> list[Run]:
    """Return the runs of the page, which write to `root`/push."""
    run = Recipe(root / "push")

    # the learning curve: six numbers of pushes, three seeds each
    data = run("data", "dipn-datagen push --episodes 52000")
    limits, steps = (" ".join(map(str, numbers)) for numbers in (STEPS, STEPS.values()))
    learnt = run("runs", f"dipn-train sweep --seeds 0 1 2 --limits {limits} --steps {steps} -- {TRAIN}", data)
    curves = [learnt / f"{pushes}-{seed}" for pushes in STEPS for seed in range(3)]
    run("curve", "dipn-eval prediction --scenes 1000 --objects paper --curve", curves)

    # one network for every distance against one for each, and one trained on masks found in the image
    alone = {
        "every": learnt / "1500-0",
        "only5": run("only5", TRAIN_1500, data, "--centimetres 5"),
        "only10": run("only10", TRAIN_1500, data, "--centimetres 10"),
        "found": run("found", TRAIN_1500, data, "--masks found"),
    }
    for name, network in alone.items():
        run(f"alone-{name}", "dipn-eval prediction --scenes 500 --objects paper --no-physics --push-net", network)

    # the shipped network where the world is not the one that it was trained in
    shifted = "dipn-eval prediction --push-net builtin --scenes 500 --no-segmented --objects"
    run("shift-none", shifted, "paper")
    run("shift-heavier", shifted, "paper --density 1000 1500")
    run("shift-lighter", shifted, "paper --density 100 200")
    run("shift-slipperier", shifted, "paper --friction 0.1 0.2")
    run("shift-stickier", shifted, "paper --friction 0.5 0.7")
    run("shift-crowded", shifted, "8:15")

    # scenes of one class of shapes only: a network trained without that class, and one trained on all
    for name, items in ITEMS.items():
        without = run(f"no-{name}", TRAIN_1500, data, f"--without {name}")
        unseen = f"dipn-eval prediction --scenes 500 --objects paper --no-segmented --items {items} --push-net"
        run(f"without-{name}", unseen, without)
        run(f"with-{name}", unseen, learnt / "1500-0", "--no-physics")

    # crowds: networks trained on 8 to 15 objects and on 1 to 7
    crowds = run("crowds", "dipn-datagen push --objects 8:15 --episodes 6600")
    crowd = run("crowd", "dipn-train push --limit 1500 --steps 3000 --data", crowds)
    crowded = "dipn-eval prediction --scenes 500 --objects 8:15 --no-segmented --no-physics --push-net"
    run("crowd-crowded", crowded, crowd)
    run("crowd-few", crowded, learnt / "1500-0")
    return run.runs


SHIFTS = {
    "shift-none": "as trained on",
    "shift-heavier": "density 1,000 to 1,500 kg/m³ (250 to 750)",
    "shift-lighter": "density 100 to 200 kg/m³",
    "shift-slipperier": "friction 0.1 to 0.2 (0.28 to 0.42)",
    "shift-stickier": "friction 0.5 to 0.7",
    "shift-crowded": "8 to 15 objects (1 to 7)",
}
"""Differences of the scenes in each such run (and from what the network was trained on)."""

COLUMNS = [(f"{c}cm", which) for c in curves.DISTANCES for which in ("all", "moved")]
"""Distance and objects of each column of errors."""
TITLES = [f"{at.replace('cm', ' cm')}, {which}" for at, which in COLUMNS]
"""Titles of the columns of errors."""


def shift_table(values: dict[str, Any]) -> str:
    """Return a table of the shipped network, the best case and a baseline in worlds unlike the training data."""
    rows = []
    for shift, title in SHIFTS.items():
        for name in ("dipn", "physics", "trans"):
            keys = [f"{shift}/push_error/{name}/{at}/{which}" for at, which in COLUMNS]
            if all(key in values for key in keys):
                cells = [f"{values[key]:.3f}" for key in keys]
                rows.append([title, name, *cells])
    return markdown.table(["scenes", "predictor", *TITLES], rows)


def alone_table(values: dict[str, Any]) -> str:
    """Return a table of one network for all distances, one for each, and one trained on found masks; 1,500 pushes."""
    names = {"every": "one network for 1 to 10 cm", "only5": "trained for 5 cm", "only10": "trained for 10 cm"}
    names["found"] = "1 to 10 cm, trained on masks found in the image"
    columns = [(f"push_error{masks}", at, which) for masks in ("", "_segmented") for at, which in COLUMNS]
    titles = [f"{title}{end}" for end in ("", ", found masks") for title in TITLES]
    rows = []
    for name, title in names.items():
        cells = []
        for measure, at, which in columns:
            asked = not name.startswith("only") or at == f"{name.removeprefix('only')}cm"
            cells.append(f"{values[f'alone-{name}/{measure}/dipn/{at}/{which}']:.3f}" if asked else "")
        rows.append([title, *cells])
    return markdown.table(["network", *titles], rows)


def unseen_table(values: dict[str, Any]) -> str:
    """Return a table on scenes of one class of shapes: a network trained without the class, and one with all."""
    rows = []
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
            rows.append([name.replace("_", " "), title, *cells])
    return markdown.table(["shapes", "predictor", *TITLES], rows)


def crowd_table(values: dict[str, Any]) -> str:
    """Return a table on scenes of 8 to 15 objects: networks trained on such scenes, and on 1 to 7."""
    rows = []
    trained = {
        "crowd-few": "1,500 pushes, 1 to 7 objects",
        "crowd-crowded": "1,500 pushes, 8 to 15 objects",
        "shift-crowded": "51,000 pushes, 1 to 7 objects",
    }
    for folder, title in trained.items():
        cells = [f"{values[f'{folder}/push_error/dipn/{at}/{which}']:.3f}" for at, which in COLUMNS]
        rows.append([title, *cells])
    return markdown.table(["trained on", *TITLES], rows)


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
"""Rows of the table of goals: title, key, whether it is divided by the better baseline, and goals at 5 and 10 cm."""


def goal_table(values: dict[str, Any]) -> str:
    """Return a table of the goals and what was measured."""
    rows = []
    for title, key, over, goals in GOALS:
        cells = []
        for at, goal in zip(("5cm", "10cm"), goals, strict=True):
            level = min(values[f"push_error/{name}/{at}/moved"] for name in ("trans", "static")) if over else 1.0
            cells += [f"<= {goal:.2f}", f"{values[key.format(at)] / level:.3f}"]
        rows.append([title, *cells])
    return markdown.table(["figure", "5 cm, goal", "5 cm", "10 cm, goal", "10 cm"], rows)


def tables(values: dict[str, Any]) -> list[str]:
    """Return all tables of the page."""
    pages = [curves.push_table(values, which=which) for which in ("all", "moved")]
    return [
        goal_table(values),
        *pages,
        alone_table(values),
        shift_table(values),
        unseen_table(values),
        crowd_table(values),
    ]


def write_page(root: pathlib.Path, *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write push-prediction.json, the tables of push-prediction.md and its figures to `docs`."""
    listed = list_runs(root)
    curves = root / "push" / "curve"
    values = files.read_json(curves / "metrics.json")
    begins = ("alone-", "shift-", "with-", "without-", "crowd-")
    for run in sorted((run for run in listed if run.name.startswith(begins)), key=lambda run: run.name):
        found = files.read_json(run.out / "metrics.json")
        values |= {f"{run.name}/{key}": value for key, value in found.items() if key.startswith("push_")}
    values[pages.MADE] = pages.made(listed)
    pages.write("push-prediction", values, tables(values), docs=docs)
    for which in ("all", "moved"):
        shutil.copy(curves / f"curve-{which}.png", docs / f"push-prediction-{which}.png")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return command.main("push_prediction", str(__doc__), list_runs, page=write_page, arguments=arguments)


if __name__ == "__main__":
    sys.exit(main())
