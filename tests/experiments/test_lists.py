"""The lists of runs: every command is accepted by its own parser."""

import itertools
import pathlib
from types import ModuleType
from typing import get_args

import pytest

from dipn_jax.names import MethodName
from experiments import clearing, demo, grasping, push_prediction, runs

EXPERIMENTS = (demo, push_prediction, grasping, clearing)

each = pytest.mark.parametrize("experiment", EXPERIMENTS, ids=lambda module: module.__name__.rpartition(".")[2])


@each
def test_a_dry_run_parses_every_command_and_writes_nothing(
    experiment: ModuleType,
    tmp_path: pathlib.Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if experiment is clearing:  # as if nothing was kept of it
        monkeypatch.setattr(clearing, "KEPT", tmp_path / "none.json")
    assert experiment.main(["--dry-run", "--out", str(tmp_path / "out")]) == 0
    said, listed = capfd.readouterr(), experiment.list_runs(tmp_path / "out")
    assert said.out.count("\n") == len(listed) > 10 and not said.err
    assert list(tmp_path.iterdir()) == []


@each
def test_every_folder_that_a_run_reads_is_written_before(experiment: ModuleType) -> None:
    root = pathlib.Path("results")
    listed = experiment.list_runs(root)
    assert len({run.name for run in listed}) == len({run.out for run in listed}) == len(listed)
    written: set[pathlib.Path] = set()
    for run in listed:
        read = {pathlib.Path(word) for word in run.command if word.startswith(f"{root}/")} - {run.out}
        for place in read:
            assert any(place.is_relative_to(out) for out in written), run.name
        written.add(run.out)
    assert len(runs.keys(listed)) == len(listed)


@each
def test_runs_are_listed_and_an_unknown_name_is_refused(
    experiment: ModuleType, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert experiment.main(["--list"]) == 0
    assert capfd.readouterr().out.count("\n  dipn-") == len(experiment.list_runs(tmp_path))
    assert experiment.main(["--only", "nothing"]) == 2
    assert capfd.readouterr().err.count("\n") == 1


def test_every_training_of_every_budget_clears_with_every_method() -> None:
    names = {run.name for run in clearing.list_runs(pathlib.Path("results"))}
    methods = set(get_args(MethodName)) - {"physics+gn"}
    for budget, (_, trainings, _) in clearing.BUDGETS.items():
        for seed, on, aids, method in itertools.product(range(trainings), ("hard", "heldout"), clearing.AIDS, methods):
            assert f"table/{on}/{budget}/{aids}/{method}/{seed}" in names


def test_the_recipes_that_figures_were_made_with() -> None:
    root = pathlib.Path("results")
    push, grasp, clear = (
        {run.name: run for run in module.list_runs(root)} for module in (push_prediction, grasping, clearing)
    )
    assert push["runs"].line == (
        "dipn-train sweep --seeds 0 1 2 --limits 100 300 500 1000 1500 51000 --steps 600 1000 1500 2500 3000 10000 "
        "--out results/push/runs -- push --eval-every 1000 --save-every 1000 --data results/push/data"
    )
    assert push["with-concave"].line == (
        "dipn-eval prediction --scenes 500 --objects paper --no-segmented --items concave concave_slim "
        "--push-net results/push/runs/1500-0 --no-physics --out results/push/with-concave"
    )
    data = " ".join(f"results/grasp/{name}" for name in ("first", "second", "third", "fourth", "fifth"))
    assert grasp["shipped"].line == (
        f"dipn-train grasp --batch 64 --data {data} --steps 2200 --learning-rate 1e-3 --init results/grasp/fourfold "
        "--out results/grasp/shipped"
    )
    assert clear["table/hard/paper/bare/dqn+gn/2"].line == (
        "dipn-eval clear --cases hard --instances 10 --label paper-bare-2 --aids --method dqn+gn "
        "--value-net results/clear/paper/2/dqn --grasp-net results/clear/paper/2/gn "
        "--out results/clear/table/hard/paper/bare/dqn+gn/2"
    )
    key = runs.keys(list(clear.values()))["grasp/pretrained"]
    assert key == runs.keys(list(grasp.values()))["pretrained"]
