"""Clearing: every method with the paper's samples and with more, and all other results on docs/clearing.md.

    python -m experiments.clearing          # or make clear-figures

Hours on 2 cores, and before them the pushes of `experiments.push_prediction` and the pre-trained network of
`experiments.grasping`, if they are not there yet. It can be interrupted; the same command continues.
"""

from __future__ import annotations

import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Any

from dipn_jax.eval.clearing import sweeping
from dipn_jax.eval.report import comparison, paper

from dipn_jax import files
from experiments import command, grasping, pages, push_prediction
from experiments.runs import Part, Recipe, Run

HARD = "--cases hard --instances 30"
"""Options for the ten hard cases, 30 times each."""

TABLES = {
    "hard": HARD,
    "30": "--cases random --objects 30 --instances 30",
    "10": "--cases random --objects 10 --instances 30",
}
"""Tables of the methods with the paper's samples, by the end of a run's name."""

FEWER_TABLES = {"hard": HARD, "30": "--cases random --objects 30 --instances 10"}
"""Tables of the methods with more samples."""

BUILTIN = "--push-net builtin --grasp-net builtin"
"""Options for the networks that come with the package."""


def list_runs(root: pathlib.Path) -> list[Run]:
    """Return the runs of the page, which write to `root`/clear."""
    run = Recipe(root / "clear")
    pushes = run.borrow(push_prediction.list_runs(root), "data", prefix="push")
    pretrained = run.borrow(grasping.list_runs(root), "pretrained", prefix="grasp")
    evaluated = _paper_samples(run, pushes, pretrained)
    evaluated += _more_samples(run)

    # the shipped networks with scores and rule exactly as published
    unguarded = "--label unguarded --no-cautious --no-remember"
    evaluated.append(run("table/unguarded-hard", "dipn-eval clear", HARD, unguarded, BUILTIN))

    run("report", "dipn-eval report --clear", sorted(evaluated), out=run.folder)
    run("sweep", f"dipn-eval sweep {BUILTIN} --distances 0.03:0.12:0.01 --instances 3")
    return run.runs


def _paper_samples(run: Recipe, pushes: pathlib.Path, pretrained: pathlib.Path) -> list[pathlib.Path]:
    """Add every method with the samples that the paper gives it, and the shipped networks; return the evaluations."""
    gn = run("gn", "dipn-train grasp-online --grasps 500 --init", pretrained)
    dipn = run("dipn", "dipn-train push --limit 1500 --steps 3000 --data", pushes)
    dipn_2000 = run("dipn-2000", "dipn-train push --limit 2000 --steps 3000 --data", pushes)
    dqn = run("dqn", "dipn-train baseline --method dqn --actions 1500 --grasp-net", gn)
    rea = run("rea", "dipn-train baseline --method rea --actions 1500")
    vpg = run("vpg", "dipn-train baseline --method vpg --actions 2500")
    methods: dict[str, tuple[Part, ...]] = {
        "large": (f"--label large {BUILTIN}",),
        "dipn-gn": ("--label paper --push-net", dipn, "--grasp-net", gn),
        "vpg": ("--label paper --method vpg --value-net", vpg),
        "rea-dipn": ("--label paper --method rea+dipn --push-net", dipn_2000, "--value-net", rea),
        "dqn-gn": ("--label paper --method dqn+gn --value-net", dqn, "--grasp-net", gn),
    }
    evaluated = _evaluate(run, methods, TABLES)
    return evaluated + _evaluate(run, {"gn-paper": ("--label paper --method gn --grasp-net", gn)}, {"hard": HARD})


def _more_samples(run: Recipe) -> list[pathlib.Path]:
    """Add the compared methods with more samples, and the shipped GN without pushes; return the evaluations."""
    dqn = run("dqn-large", "dipn-train baseline --method dqn --actions 3000 --grasp-net builtin")
    rea = run("rea-large", "dipn-train baseline --method rea --actions 3000")
    vpg = run("vpg-large", "dipn-train baseline --method vpg --actions 4000")
    methods: dict[str, tuple[Part, ...]] = {
        "vpg-large": ("--label large --method vpg --value-net", vpg),
        "rea-dipn-large": ("--label large --method rea+dipn --push-net builtin --value-net", rea),
        "dqn-gn-large": ("--label large --method dqn+gn --grasp-net builtin --value-net", dqn),
        "gn-only": ("--label large --method gn --grasp-net builtin",),
        "physics-gn": ("--label large --method physics+gn --grasp-net builtin",),
    }
    return _evaluate(run, methods, FEWER_TABLES)


def _evaluate(run: Recipe, methods: dict[str, tuple[Part, ...]], tables: dict[str, str]) -> list[pathlib.Path]:
    """Add an evaluation of each of `methods` on each of `tables`."""
    return [
        run(f"table/{method}-{on}", "dipn-eval clear", which, *options)
        for on, which in tables.items()
        for method, options in methods.items()
    ]


TITLES = {
    "completion": "completion",
    "grasp_success_completed": "grasp success, completed",
    "grasp_success_all": "all",
    "efficiency_completed": "efficiency, completed",
    "efficiency_all": "all",
}
"""Measures of the tables, and their titles."""


def _cell(values: dict[str, Any], at: str) -> str:
    if values.get(at) is None:
        return "-"
    value, low, high = (100 * values[f"{at}{end}"] for end in ("", "_low", "_high"))
    return f"{value:.1f} [{low:.0f}, {high:.0f}]"


def table(values: dict[str, Any], tables: str) -> str:
    """Return a table of all methods on one kind of tables, in per cent, with the paper's numbers for the same."""
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
    """Return all tables of the page."""
    return [table(values, kind) for kind in sorted({key.split("/")[1] for key in values if key.startswith("clear/")})]


def swept(values: dict[str, Any]) -> str:
    """Return a table of what `dipn-eval sweep` found at each distance; errors are true 1-IoU of moved objects."""
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


def write_page(root: pathlib.Path, *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write clearing.json, sweep.json, the tables of clearing.md and its figure to `docs`."""
    listed = list_runs(root)
    folders = sorted(run.out for run in listed if run.name.startswith("table/"))
    values = comparison.flat([comparison.Cleared(folder) for folder in folders])
    values[pages.MADE] = pages.made(listed)
    found = files.read_json(root / "clear" / "sweep" / "metrics.json")
    sweep = {key: value for key, value in found.items() if key.startswith("sweep/")}
    files.write_json(docs / "sweep.json", sweep)
    pages.write("clearing", values, [*tables(values), swept(sweep)], docs=docs)
    shutil.copy(root / "clear" / "sweep" / "sweep.png", docs / "sweep.png")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return command.main("clearing", str(__doc__), list_runs, page=write_page, arguments=arguments)


if __name__ == "__main__":
    sys.exit(main())
