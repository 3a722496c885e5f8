"""Grasping: the learning curves, the network that comes with the package, and all other results on docs/grasping.md.

    python -m experiments.grasping          # or make grasp-figures

Two hours on 2 cores. It can be interrupted; the same command continues. The network that comes with the package is the
run `shipped`, exported:

    dipn-train export --network grasp --run results/grasp/shipped --out dipn_jax/data/grasp
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
from experiments import command, pages
from experiments.runs import Recipe, Run

NO_ARCHES = (
    "triangle cuboid_half cuboid_flat cuboid_long cube half_cylinder cylinder cylinder_flat half_cylinder_large "
    "cuboid_mid cuboid_square triangle_flat"
)
"""All items of the catalogue but the arches."""


def list_runs(root: pathlib.Path) -> list[Run]:
    """Return the runs of the page, which write to `root`/grasp."""
    run = Recipe(root / "grasp")
    images = run("images", "dipn-datagen images --episodes 100")
    pretrained = run("pretrained", "dipn-train grasp-pretrain --steps 400 --data", images)
    _online(run, pretrained)
    _shipped(run, pretrained)
    run("builtin-10", "dipn-eval grasp --scenes 200 --others 15 --grasp-net builtin")
    run("builtin-30", "dipn-eval grasp --scenes 30 --objects 30 --others 15 --grasp-net builtin")
    _without_arches(run)
    return run.runs


def _online(run: Recipe, pretrained: pathlib.Path) -> None:
    """Add the runs of learning while grasping: eight seeds with pre-training, three without."""
    online = "grasp-online --grasps 400"
    after = run("runs/with", f"dipn-train sweep --seeds 0 1 2 3 4 5 6 7 -- {online} --init", pretrained)
    plain = run("runs/without", f"dipn-train sweep --seeds 0 1 2 -- {online}")
    learnt = [after / f"seed-{seed}" for seed in range(8)] + [plain / f"seed-{seed}" for seed in range(3)]
    run("online", "dipn-eval grasp --curve", learnt)


def _shipped(run: Recipe, pretrained: pathlib.Path) -> None:
    """Add the runs of the shipped network: five data sets, the grasps of each chosen by the network before it."""
    train = "dipn-train grasp --batch 64 --data"
    first = run("first", "dipn-datagen grasp --actions 6 --objects 1:12 --episodes 12000 --grasp-net", pretrained)
    once = run("once", train, first, "--steps 1500 --learning-rate 2e-3 --init", pretrained)

    chosen = "dipn-datagen grasp --actions 8 --objects"
    second = run("second", chosen, "1:20 --episodes 6000 --seed 1 --guided 0.6 --unsure 0.3 --grasp-net", once)
    twice = run("twice", train, [first, second], "--steps 2500 --learning-rate 2e-3 --init", pretrained)

    # packed rows, in which GN was too sure of itself
    packed = "3:8 --packed 1 --episodes 9000 --seed 5 --guided 0.6 --unsure 0.3 --grasp-net"
    third = run("third", chosen, packed, twice)
    thrice = run("thrice", train, [first, second, third], "--steps 3500 --learning-rate 2e-3 --init", pretrained)

    packed = "3:8 --packed 1 --episodes 8000 --seed 7 --guided 0.7 --unsure 0.25 --grasp-net"
    fourth = run("fourth", chosen, packed, thrice)
    rates = "--steps 3000 --learning-rate 1.5e-3 --init"
    fourfold = run("fourfold", train, [first, second, third, fourth], rates, thrice)

    packed = "3:9 --packed 0.8 --episodes 6000 --seed 9 --guided 0.7 --unsure 0.25 --grasp-net"
    fifth = run("fifth", chosen, packed, fourfold)
    rates = "--steps 2200 --learning-rate 1e-3 --init"
    run("shipped", train, [first, second, third, fourth, fifth], rates, fourfold)


def _without_arches(run: Recipe) -> None:
    """Add a network trained without arches, and its evaluation on arches."""
    images = run("no-arches/images", f"dipn-datagen images --items {NO_ARCHES} --episodes 100")
    pretrained = run("no-arches/pretrained", "dipn-train grasp-pretrain --steps 400 --data", images)
    chosen = f"dipn-datagen grasp --actions 6 --items {NO_ARCHES} --objects 1:12 --episodes 5000 --grasp-net"
    grasps = run("no-arches/grasps", chosen, pretrained)
    rates = "--steps 800 --learning-rate 2e-3 --init"
    network = run("no-arches/gn", "dipn-train grasp --batch 64 --data", grasps, rates, pretrained)
    evaluate = "dipn-eval grasp --scenes 50 --items concave concave_slim --others 15 --grasp-net"
    run("unseen-concave", evaluate, network)


COUNTS = (50, 100, 200, 300, 400)
"""Numbers of grasps in the columns of the table of learning while grasping."""

ROWS = {
    "builtin-10": "10 objects",
    "builtin-30": "30 objects",
    "unseen-concave": "10 arches, never trained on",
}
"""Evaluations in the table of success, and their titles."""

RATES = {"gn": "GN, until the table is empty", "gn_first": "GN, first grasp", "random_foreground": "random foreground"}
"""Rates of success in that table, and their titles."""


def success_table(values: dict[str, Any]) -> str:
    """Return a table of the shipped network's success, with 95 % intervals, and what physics allows."""
    titles = [*RATES.values(), "tables", "grasps", "tables emptied", "best case", "ECE"]
    rows = []
    for row, title in ROWS.items():
        if f"{row}/attempts" not in values:
            continue
        cells = []
        for name in RATES:
            value, low, high = (100 * values[f"{row}/grasp_success/{name}{end}"] for end in ("", "_low", "_high"))
            cells.append(f"{value:.1f} [{low:.1f}, {high:.1f}] %")
        cells += [str(values[f"{row}/{key}"]) for key in ("scenes", "attempts", "table/ended_cleared")]
        best_case = values.get(f"{row}/other_grasps/ceiling")
        cells += ["" if best_case is None else f"{100 * best_case:.1f} %"]
        cells += [f"{values[f'{row}/expected_calibration_error']:.3f}"]
        rows.append([title, *cells])
    return markdown.table(["", *titles], rows)


def label_table(values: dict[str, Any]) -> str:
    """Return a table of how far the labels of pre-training agree with physics, on single objects."""
    at = "builtin-10/labels_of_single_objects"
    shares = [f"{100 * values[f'{at}/{key}']:.0f} %" for key in ("agree", "positive_holds", "negative_fails")]
    head = ["random grasps", "agree", "positives that hold", "negatives that fail"]
    return markdown.table(head, [[str(values[f"{at}/grasps"]), *shares]])


def tables(values: dict[str, Any]) -> list[str]:
    """Return all tables of the page."""
    return [success_table(values), curves.grasp_table(values, COUNTS), label_table(values)]


def write_page(root: pathlib.Path, *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write grasping.json, the tables of grasping.md and its figures to `docs`."""
    results = root / "grasp"
    values = files.read_json(results / "online" / "metrics.json")
    for row in ROWS:
        found = files.read_json(results / row / "metrics.json")
        values |= {f"{row}/{key}": value for key, value in found.items()}
    values[pages.MADE] = pages.made(list_runs(root))
    pages.write("grasping", values, tables(values), docs=docs)
    shutil.copy(results / "online" / "curve.png", docs / "grasping-online.png")
    shutil.copy(results / "builtin-10" / "reliability.png", docs / "grasping-reliability.png")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return command.main("grasping", str(__doc__), list_runs, page=write_page, arguments=arguments)


if __name__ == "__main__":
    sys.exit(main())
