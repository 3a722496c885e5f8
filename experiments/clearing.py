"""Clearing: every method with the same chances, and all other results on docs/clearing.md.

    python -m experiments.clearing          # or make clear-figures
    python -m experiments.clearing --page   # the page from what is kept, complete or not

A day or two on 2 cores. It can be interrupted; the same command continues, on another machine too: results are kept
table by table in docs/clearing-tables.json, and trainings that only they need are not repeated.
"""

from __future__ import annotations

import pathlib
import shutil
import sys
from collections.abc import Sequence

from dipn_jax.names import ALL_AIDS
from dipn_jax.system import files
from experiments import clearing_numbers, clearing_tables, command, grasping, pages
from experiments.kept_results import Kept
from experiments.runs import Part, Recipe, Run

KEPT = pages.DOCS / "clearing-tables.json"
"""File of the results, table by table."""

TABLES = {
    "hard": "--cases hard --instances 10",
    "heldout": "--cases heldout --instances 5",
    "random-10": "--cases random --objects 10 --instances 30",
    "random-30": "--cases random --objects 30 --instances 20",
}
"""Options for the tables that every method clears; random ones with its first training only."""

AIDS = {"all": "", "bare": "--aids"}
"""Options for every method with all aids, and without any."""

BUILTIN = "--push-net builtin --grasp-net builtin"
"""Options for the networks that come with the package."""

PAPER = {"gn": 500, "dipn": 1500, "rea": 1500, "rea-dipn": 2000, "dqn": 1500, "vpg": 2500}
"""Samples of each network, as many as the paper gives it."""
LARGE = {"gn": 5000, "dipn": 5000, "rea": 5000, "rea-dipn": 5000, "dqn": 5000, "vpg": 10_000}
"""Samples of each network where all methods have 10,000 in all."""
BUDGETS = {"paper": (PAPER, 3, 3000), "large": (LARGE, 2, 10_000)}
"""Samples, number of trainings, and steps of a DIPN: two a push, as those that learn online take two an action (but 1.5
for the 2,000 pushes of REA+DIPN with *paper*).
"""

NOISE = {
    "height-1mm": "--height-noise 0.001",
    "height-2mm": "--height-noise 0.002",
    "height-4mm": "--height-noise 0.004",
    "holes": "--holes 0.05",
    "image": "--image-noise 0.03",
    "all-noise": "--height-noise 0.002 --holes 0.05 --image-noise 0.03",
}
"""Kinds of noise of the camera."""

CHANGED = {
    "heavy": "--cases random --objects 10 --instances 30 --density 1000 2000",
    "slippery": "--cases random --objects 10 --instances 30 --friction 0.12 0.2",
    "rough": "--cases random --objects 10 --instances 30 --friction 0.6 0.9",
    "large": "--cases random --objects 10 --instances 30 --scale 1.1 1.2",
    "packed": "--cases random --objects 8 --instances 30 --packed 1",
    "arches": "--cases random --objects 10 --instances 30 --items concave concave_slim",
}
"""Tables on which physics or sizes are other than in training; packed rows; and tables with nothing but arches."""
COMPARED = ("dipn+gn", "gn", "dqn+gn")
"""Methods that clear these tables, with networks of the budget `paper`."""


def list_runs(root: pathlib.Path) -> list[Run]:
    """Return the runs of the page, which write to `root`/clear; the most telling ones first."""
    run = Recipe(root / "clear")
    _shipped(run)
    _details(run)
    pushes = run("pushes", "dipn-datagen push --episodes 5600")
    learnt_from = [(pushes, run.borrow(grasping.list_runs(root), "pretrained", prefix="grasp"))]
    learnt_from += [_own_data(run, seed) for seed in range(1, max(number for _, number, _ in BUDGETS.values()))]
    for budget, (_, trainings, _) in BUDGETS.items():
        for seed in range(trainings):
            methods = _train(run, budget, seed, *learnt_from[seed])
            on_all = TABLES if seed == 0 else {on: TABLES[on] for on in ("hard", "heldout")}
            for aids, extra in AIDS.items():
                for on, which in on_all.items():
                    for method, options in methods.items():
                        label = f"--label {budget}-{aids}-{seed}"
                        name = f"table/{on}/{budget}/{aids}/{method}/{seed}"
                        run(name, "dipn-eval clear", which, label, extra, *options)
            if (budget, seed) == ("paper", 0):
                _changed(run, budget, methods, CHANGED)
    _changed(run, "unseen", _train_without_arches(run, pushes), {"arches": CHANGED["arches"]})
    run("sweep", f"dipn-eval sweep {BUILTIN} --distances 0.03:0.12:0.01 --instances 3")
    return run.runs


def _own_data(run: Recipe, seed: int) -> tuple[pathlib.Path, pathlib.Path]:
    """Add pushes and a pre-training of their own for one seed, as the learners that act have their own tables."""
    at, seeded = f"data/{seed}", f"--seed {seed}"
    pushes = run(f"{at}/pushes", "dipn-datagen push --episodes 5600", seeded)
    images = run(f"{at}/images", "dipn-datagen images --episodes 100", seeded)
    return pushes, run(f"{at}/pretrained", "dipn-train grasp-pretrain --steps 400", seeded, "--data", images)


def _train(
    run: Recipe, budget: str, seed: int, pushes: pathlib.Path, pretrained: pathlib.Path
) -> dict[str, tuple[Part, ...]]:
    """Add one training of every network; return the options of the methods that decide with them."""
    samples, _, steps = BUDGETS[budget]
    at, seeded, learnt = f"{budget}/{seed}", f"--seed {seed}", f"dipn-train push --steps {steps}"
    gn = run(f"{at}/gn", f"dipn-train grasp-online --grasps {samples['gn']}", seeded, "--init", pretrained)
    dipn = run(f"{at}/dipn", f"{learnt} --limit {samples['dipn']}", seeded, "--data", pushes)
    if samples["rea-dipn"] == samples["dipn"]:
        other = dipn
    else:
        other = run(f"{at}/rea-dipn", f"{learnt} --limit {samples['rea-dipn']}", seeded, "--data", pushes)
    act = "dipn-train baseline --method"
    dqn = run(f"{at}/dqn", f"{act} dqn --actions {samples['dqn']}", seeded, "--grasp-net", gn)
    rea = run(f"{at}/rea", f"{act} rea --actions {samples['rea']}", seeded)
    vpg = run(f"{at}/vpg", f"{act} vpg --actions {samples['vpg']}", seeded)
    return {
        "dipn+gn": ("--push-net", dipn, "--grasp-net", gn),
        "dipn+gn+actions": ("--method dipn+gn+actions --push-net", dipn, "--grasp-net", gn),
        "gn": ("--method gn --grasp-net", gn),
        "rea+dipn": ("--method rea+dipn --push-net", other, "--value-net", rea),
        "dqn+gn": ("--method dqn+gn --value-net", dqn, "--grasp-net", gn),
        "vpg": ("--method vpg --value-net", vpg),
    }


def _train_without_arches(run: Recipe, pushes: pathlib.Path) -> dict[str, tuple[Part, ...]]:
    """Add a training of each network of COMPARED that never sees an arch; return the options of these methods."""
    others = f"--items {grasping.NO_ARCHES}"
    images = run("unseen/images", "dipn-datagen images --episodes 100", others)
    pretrained = run("unseen/pretrained", "dipn-train grasp-pretrain --steps 400 --data", images)
    gn = run("unseen/gn", f"dipn-train grasp-online --grasps {PAPER['gn']}", others, "--init", pretrained)
    dipn = run("unseen/dipn", f"dipn-train push --steps 3000 --limit {PAPER['dipn']} --without concave --data", pushes)
    act = f"dipn-train baseline --method dqn --actions {PAPER['dqn']}"
    dqn = run("unseen/dqn", act, others, "--grasp-net", gn)
    return {
        "dipn+gn": ("--push-net", dipn, "--grasp-net", gn),
        "gn": ("--method gn --grasp-net", gn),
        "dqn+gn": ("--method dqn+gn --value-net", dqn, "--grasp-net", gn),
    }


def _changed(run: Recipe, networks: str, methods: dict[str, tuple[Part, ...]], worlds: dict[str, str]) -> None:
    """Add the evaluations of COMPARED on changed worlds; `networks` names what they decide with."""
    for name, which in worlds.items():
        for method in COMPARED:
            label = f"--label {name}-{networks}"
            run(f"changed/{name}/{networks}/{method}", "dipn-eval clear", which, label, *methods[method])


def _shipped(run: Recipe) -> None:
    """Add the networks that come with the package, which learnt from more than any budget here."""
    methods = {
        "dipn+gn": BUILTIN,
        "dipn+gn+actions": f"--method dipn+gn+actions {BUILTIN}",
        "gn": "--method gn --grasp-net builtin",
        "physics+gn": "--method physics+gn --masks true --grasp-net builtin",
    }
    for on in ("heldout", "hard", "random-10", "random-30"):
        for method, options in methods.items():
            for aids, extra in AIDS.items():
                if method != "physics+gn" or (aids == "all" and on in ("heldout", "hard")):
                    name = f"table/{on}/shipped/{aids}/{method}/0"
                    run(name, "dipn-eval clear", TABLES[on], f"--label shipped-{aids}", extra, options)


def _details(run: Recipe) -> None:
    """Add what is measured with the shipped networks alone: masks, noise, aids, changed worlds."""
    heldout, clear = TABLES["heldout"], "dipn-eval clear"
    for on, which in TABLES.items():
        run(f"masks/{on}/true", clear, which, BUILTIN, "--masks true --label true-masks")
    for name, options in NOISE.items():
        run(f"noise/{name}", clear, heldout, BUILTIN, options, f"--label {name}")
    for aid in ALL_AIDS:
        others = " ".join(other for other in ALL_AIDS if other != aid)
        run(f"aids/without/{aid}", clear, heldout, BUILTIN, f"--aids {others} --label without-{aid}")
        run(f"aids/alone/{aid}", clear, heldout, BUILTIN, f"--aids {aid} --label only-{aid}")
    for name, options in CHANGED.items():
        run(f"changed/{name}/dipn+gn", clear, options, BUILTIN, f"--label {name}")
        run(f"changed/{name}/gn", clear, options, f"--method gn --grasp-net builtin --label {name}")
    chosen = "--distances 0.03 0.04 0.05 0.06 0.07 0.08 0.09 0.10 0.11 0.12 --label chosen"
    run("distance/chosen", clear, heldout, BUILTIN, chosen)


def write_page(root: pathlib.Path, *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write the tables of clearing.md, clearing.json and the figure of the sweep to `docs`, from what is kept."""
    listed, results = list_runs(root), Kept(docs / KEPT.name)
    values = clearing_numbers.numbers(listed, results)
    section = clearing_tables.section(values)
    values[pages.MADE] = results.made(listed)
    folder = root / "clear" / "sweep"
    if (folder / "metrics.json").exists():
        found = files.read_json(folder / "metrics.json")
        sweep = {key: value for key, value in found.items() if key.startswith("sweep/")}
        run = next(run for run in listed if run.out == folder)
        files.write_json(docs / "sweep.json", sweep | {pages.MADE: pages.made([run])[run.name]})
        shutil.copy(folder / "sweep.png", docs / "sweep.png")
    for name, kept in (("sweep", "sweep"), ("push_or_grasp", "push-or-grasp")):
        values[pages.MADE][name] = files.read_json(docs / f"{kept}.json")[pages.MADE]
    tables = [clearing_tables.swept(files.read_json(docs / "sweep.json"))]
    pages.write("clearing", values, tables, docs=docs, section=section)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return command.main(
        "clearing",
        str(__doc__),
        list_runs,
        page=write_page,
        page_on_request=True,
        keep_in=KEPT,
        arguments=arguments,
    )


if __name__ == "__main__":
    sys.exit(main())
