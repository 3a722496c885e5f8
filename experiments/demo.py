"""The demo: a small data set of each kind, both networks, their evaluations, and one report.

    python -m experiments.demo          # or make demo, which also sets up .venv
    python -m experiments.demo --page   # afterwards: docs/demo.json and the tables of docs/demo.md

The report is demo/report.html, its numbers demo/metrics.json. It shows that every part works, not how good the system
can be.
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import markdown
from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments import command, pages
from experiments.runs import Recipe, Run

PUSHES = 1000
"""Number of pushes that DIPN learns from."""
GRASPS = 1000
"""Number of grasps that GN learns from."""


def list_runs(root: pathlib.Path) -> list[Run]:
    """Return the demo's commands, which write to `root`."""
    run = Recipe(root)

    # episodes
    pushes = run("data/push", f"dipn-datagen push --episodes {PUSHES}")
    images = run("data/images", "dipn-datagen images --episodes 100")
    pretrained = run("runs/gn-pretrained", "dipn-train grasp-pretrain --steps 200 --data", images)
    grasps = run(
        "data/grasp",
        f"dipn-datagen grasp --objects 1:10 --episodes {GRASPS} --shard-size 500 --grasp-net",
        pretrained,
    )

    # networks
    dipn = run("runs/dipn", "dipn-train push --steps 800 --data", pushes)
    gn = run("runs/gn", "dipn-train grasp --steps 400 --data", grasps, "--init", pretrained)

    # what they are worth
    prediction = run("eval/prediction", "dipn-eval prediction --scenes 100 --push-net", dipn)
    success = run("eval/grasp", "dipn-eval grasp --scenes 20 --grasp-net", gn)
    networks = ("--push-net", dipn, "--grasp-net", gn)
    hard = run("eval/hard", "dipn-eval clear --cases hard --candidates 16", *networks)
    random = run("eval/random", "dipn-eval clear --cases random --objects 10 --instances 4 --candidates 16", *networks)

    evaluations = ("--prediction", prediction, "--grasp", success, "--clear", [hard, random])
    run("report", "dipn-eval report", *evaluations, "--runs", [dipn, pretrained, gn], out=root)
    return run.runs


PREDICTORS = {
    "dipn": f"DIPN (`compact`, {PUSHES:,} pushes, a tenth of them held out)",
    "trans": "`trans`: only the pushed object moves",
    "static": "`static`: nothing moves",
    "physics": "the engine itself, nominal mass and friction",
}
"""Rows of the table of prediction errors, and their titles."""

TABLES = {"hard": "the ten hard instances, once each", "random-10": "random, 10 objects"}
"""Rows of the table of cleared tables, and their titles."""


def _share(values: dict[str, Any], key: str) -> str:
    """Return a share with its interval, in per cent."""
    return f"{100 * values[key]:.1f} [{100 * values[f'{key}_low']:.0f}, {100 * values[f'{key}_high']:.0f}]"


def tables(values: dict[str, Any]) -> list[str]:
    """Return all tables of the page, from the numbers of the report."""
    columns = ("5cm/all", "5cm/moved", "10cm/all", "10cm/moved")
    errors = [
        [title, *(f"{values[f'push_error/{name}/{column}']:.3f}" for column in columns)]
        for name, title in PREDICTORS.items()
    ]
    gn = f"GN (`compact`, {GRASPS:,} grasps, a tenth of them held out): all {values['attempts']} until empty"
    grasps = [
        [title, _share(values, f"grasp_success/{name}")]
        for name, title in (
            ("gn", gn),
            ("gn_first", "its first on each table"),
            ("random_foreground", "random foreground pixel, random angle"),
        )
    ]
    shares = ("completion", "grasp_success_all", "efficiency_all")
    cleared = []
    for name, title in TABLES.items():
        at = f"clear/{name}/dipn+gn"
        cells = [_share(values, f"{at}/{key}") for key in shares]
        cleared.append([title, f"{values[f'{at}/instances']}", *cells, f"{values[f'{at}/pushes']}"])
    errors_of = f"error of the predicted masks, true 1-IoU, {values['pushes']} held-out pushes"
    grasps_on = f"grasps on {values['scenes']} unseen tables of 10 objects"
    headings = ["tables", "completion", "grasp success, all", "efficiency, all", "pushes"]
    return [
        markdown.table([errors_of, "5 cm, all objects", "5 cm, moved", "10 cm, all", "10 cm, moved"], errors),
        markdown.table([grasps_on, "success %"], grasps),
        markdown.table(["clearing with Alg. 2, %", *headings], cleared),
    ]


def write_page(root: pathlib.Path, *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write demo.json, and the tables and the box of demo.md, to `docs`.

    Raises:
      UserError: the demo in `root` is not complete.
    """
    metrics = root / "metrics.json"
    if not metrics.exists():
        raise UserError(f"{metrics}: no such file; it is written by python -m experiments.demo --out {root}")
    values = files.read_json(metrics)
    values[pages.MADE] = pages.made(list_runs(root))
    pages.write("demo", values, tables(values), docs=docs)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return command.main(
        "demo",
        str(__doc__),
        list_runs,
        folder="demo",
        page=write_page,
        page_on_request=True,
        arguments=arguments,
    )


if __name__ == "__main__":
    sys.exit(main())
