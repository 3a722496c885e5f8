"""Results that are kept table by table, and the tables that are made of them."""

import pathlib
from typing import Any

import pytest
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import lockstep

from dipn_jax.system import files
from experiments import clearing_numbers, clearing_tables, kept_results, runs
from experiments.kept_results import Kept
from experiments.runs import Recipe, Run

ENTRY = {"name": "01", "ended": "cleared", "objects": 5, "removed": 5, "held": 4, "grasps": 5, "pushes": 1}
"""What `episodes.json` says of a table."""


def _run(folder: pathlib.Path, name: str, entries: list[dict[str, Any]]) -> Run:
    """Return a run that has ended."""
    run = Run(name, folder / name, ("dipn-eval", "clear", "--out", str(folder / name)))
    files.write_json(run.out / "episodes.json", entries)
    files.write_json(run.out / "settings.json", {"networks": {"builtin": {"digest": "abc"}}, "code": "def"})
    runs.write_stamp(run, "key", complete=True)
    return run


def test_what_is_kept_is_what_was_found(tmp_path: pathlib.Path) -> None:
    lost = ENTRY | {"name": "02", "ended": "pushed out", "removed": 1, "held": 1, "grasps": 2, "pushes": 3}
    run = _run(tmp_path, "a", [ENTRY, lost, ENTRY])
    results = Kept(tmp_path / "kept.json")
    results.keep(run, "key")
    again = Kept(tmp_path / "kept.json")
    assert again.has(run, "key") and not again.has(run, "other")
    assert again.tables(run, "other") is None, "of another command"
    assert again.found["a"]["networks"] == [{"digest": "abc"}] and again.found["a"]["code"] == "def"
    tables = again.tables(run, "key")
    assert tables is not None and [table.name for table in tables] == ["01", "02", "01"]
    assert tables[1] == lockstep.Outcome("02", "pushed out", 5, 1, 1, 2, 3)
    assert again.made([run])["a"]["made_by"][-1]["cores"] >= 1
    assert Kept(tmp_path / "none.json").tables(run, "key") is None


def test_only_what_is_missing_is_carried_out_and_what_that_needs(tmp_path: pathlib.Path) -> None:
    recipe = Recipe(tmp_path)
    network = recipe("net", "dipn-train push --data x")
    recipe("one", "dipn-eval clear --push-net", network)
    recipe("two", "dipn-eval clear --push-net", network, "--seed 2")
    recipe("three", "dipn-eval clear")
    listed, found = recipe.runs, runs.keys(recipe.runs)
    results = Kept(tmp_path / "kept.json")

    def left(*only: str) -> list[str]:
        return [run.name for run in kept_results.missing(listed, only, found, results)]

    assert left() == ["net", "one", "two", "three"]
    results.found |= {name: {"key": found[name]} for name in ("one", "three")}
    assert left() == ["net", "two"] and left("one") == [] and left("net") == ["net"]
    results.found["two"] = {"key": "of another command"}
    assert left() == ["net", "two"]
    results.found["two"] = {"key": found["two"]}
    assert left() == []


def _kept(tmp_path: pathlib.Path, rows: dict[str, list[int]]) -> tuple[list[Run], Kept]:
    """Return runs that cleared tables of two cases, each with the numbers of grasps given."""
    results, listed = Kept(tmp_path / "kept.json"), []
    for name, grasps in rows.items():
        entries = [ENTRY | {"name": f"0{i // 2}", "grasps": count, "pushes": 0} for i, count in enumerate(grasps)]
        listed.append(_run(tmp_path, name, entries))
        results.keep(listed[-1], runs.keys(listed[-1:])[name])
    return listed, results


def test_trainings_are_paired_by_their_seed(tmp_path: pathlib.Path) -> None:
    rows = {
        "table/hard/paper/all/dipn+gn/1": [5, 5],
        "table/hard/paper/all/gn/0": [50, 50],
        "table/hard/paper/all/gn/1": [5, 5],
    }
    values = clearing_numbers.numbers(*_kept(tmp_path, rows))
    assert values["table/hard/paper/all/gn/efficiency_all_difference"] == 0, (
        "the first training was compared with the second"
    )


def test_numbers_of_several_trainings_and_differences(tmp_path: pathlib.Path) -> None:
    rows = {
        "table/hard/paper/all/dipn+gn/0": [5, 5, 10, 10],
        "table/hard/paper/all/dipn+gn/1": [5, 5, 5, 5],
        "table/hard/paper/all/gn/0": [10, 10, 20, 20],
        "table/hard/paper/all/gn/1": [10, 10, 10, 10],
    }
    values = clearing_numbers.numbers(*_kept(tmp_path, rows))
    at = "table/hard/paper/all/dipn+gn"
    assert values[f"{at}/tables"] == 8 and values[f"{at}/trainings"] == 2 and values[f"{at}/grasps"] == 50
    assert values[f"{at}/efficiency_all"] == 40 / 50
    assert values[f"{at}/efficiency_all_spread"] == pytest.approx(20 / 20 - 20 / 30)
    hits, trials = [10] * 4, [10, 10, 15, 15]  # of a table in both trainings: it is no other table in the second
    want = metrics.ratio_interval(hits, trials, groups=["a", "a", "b", "b"])
    assert (values[f"{at}/efficiency_all_low"], values[f"{at}/efficiency_all_high"]) == want[1:]
    other = "table/hard/paper/all/gn"
    assert values[f"{other}/efficiency_all_difference"] == pytest.approx(40 / 100 - 40 / 50)
    assert values[f"{other}/efficiency_all_difference_high"] < 0 and f"{at}/efficiency_all_difference" not in values
    text = clearing_tables.of_methods(values, "hard", "all")
    assert "| dipn+gn, paper (2 trainings) | 8 | 0 | 100.0 [16, 100] (0.0) |" in text and "| **-40.0** [" in text


def test_a_difference_that_may_be_nothing_is_not_bold(tmp_path: pathlib.Path) -> None:
    rows = {"table/hard/paper/all/dipn+gn/0": [5, 9, 5, 9], "table/hard/paper/all/gn/0": [9, 5, 9, 5]}
    text = clearing_tables.of_methods(clearing_numbers.numbers(*_kept(tmp_path, rows)), "hard", "all")
    assert "+0.0 [" in text and "**" not in text and "| gn, paper (1 training) |" in text


def test_changed_worlds_are_compared_with_the_same_networks_in_the_same_world(tmp_path: pathlib.Path) -> None:
    rows = {
        "changed/heavy/dipn+gn": [5, 5, 5, 5],
        "changed/heavy/gn": [10, 10, 10, 10],
        "changed/arches/dipn+gn": [5, 5, 5, 5],
        "changed/heavy/paper/dipn+gn": [20, 20, 20, 20],
        "changed/heavy/paper/dqn+gn": [10, 10, 10, 10],
    }
    values = clearing_numbers.numbers(*_kept(tmp_path, rows))
    text = clearing_tables.section(values)
    assert values["changed/heavy/gn/efficiency_all_difference"] == 0.5 - 1
    assert values["changed/heavy/paper/dqn+gn/efficiency_all_difference"] == 0.5 - 0.25
    titles = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")]
    assert titles[2:] == [
        "heavy: dipn+gn, shipped",
        "heavy: gn, shipped",
        "heavy: dipn+gn, paper",
        "heavy: dqn+gn, paper",
        "arches: dipn+gn, shipped",
    ]


def test_hindsight_chooses_the_better_table_by_table(tmp_path: pathlib.Path) -> None:
    rows = {
        "table/hard/shipped/all/dipn+gn/0": [5, 5, 5, 5],
        "table/hard/shipped/all/dipn+gn+actions/0": [5, 9, 6, 7],
        "table/hard/shipped/all/gn/0": [8, 5, 6, 5],
    }
    listed, results = _kept(tmp_path, rows)
    results.found["table/hard/shipped/all/gn/0"]["rows"][3][3] -= 1  # fewer actions, but an object is left
    values = clearing_numbers.numbers(listed, results)
    assert values["hindsight/hard/grasps"] == 5 + 5 + 6 + 7
    assert values["hindsight/hard/efficiency_all"] == pytest.approx(20 / 23)
    assert not any("hindsight" in key and ("difference" in key or "over_gn" in key) for key in values), "it is chosen"
    assert "| the better of gn and dipn+gn+actions, in hindsight | 4 |" in clearing_tables.of_methods(
        values, "hard", "all"
    )
    del results.found["table/hard/shipped/all/gn/0"]
    assert "hindsight" not in "".join(clearing_numbers.numbers(listed, results))


def test_every_group_is_compared_with_dipn_gn_on_its_own_tables() -> None:
    rivals = {
        "table/hard/paper/bare/vpg": "table/hard/paper/bare/dipn+gn",
        "masks/random-10/true": "table/random-10/shipped/all/dipn+gn",
        "changed/heavy/gn": "changed/heavy/dipn+gn",
        "noise/holes": "table/heldout/shipped/all/dipn+gn",
        "aids/alone/table": "table/heldout/shipped/all/dipn+gn",
    }
    for name, rival in rivals.items():
        assert clearing_numbers._rival(name, "dipn+gn") == rival


def test_methods_with_pushes_are_compared_with_grasping_alone_too(tmp_path: pathlib.Path) -> None:
    rows = {
        "table/hard/paper/all/dipn+gn/0": [5, 5, 10, 10],
        "table/hard/paper/all/gn/0": [10, 10, 10, 10],
        "table/hard/paper/all/vpg/0": [20, 20, 20, 20],
    }
    values = clearing_numbers.numbers(*_kept(tmp_path, rows))
    assert values["table/hard/paper/all/gn/efficiency_all_difference"] == pytest.approx(20 / 40 - 20 / 30)
    assert "table/hard/paper/all/dipn+gn/efficiency_all_over_gn" not in values, "the same with the other sign"
    assert values["table/hard/paper/all/vpg/efficiency_all_over_gn"] == 20 / 80 - 20 / 40
    assert "table/hard/paper/all/gn/efficiency_all_over_gn" not in values
    text = clearing_tables.of_methods(values, "hard", "all")
    assert "| more than GN alone |" in text.splitlines()[0]
    assert "| -25.0 [-25.0, -25.0] |" in text, "an interval without width is not sure"
    assert "show 3 differences, each with an interval of its own; 1 of these" in clearing_tables.multiplicity(values)


def test_luck_is_the_better_of_a_method_and_itself(tmp_path: pathlib.Path) -> None:
    rows = {"table/heldout/shipped/all/dipn+gn/0": [5, 9, 6, 7], "noise/height-2mm": [8, 5, 6, 5]}
    values = clearing_numbers.numbers(*_kept(tmp_path, rows))
    assert values["hindsight/luck/grasps"] == 5 + 5 + 6 + 5 and "hindsight/heldout/grasps" not in values
    assert "hindsight/luck/efficiency_all_difference" not in values, "what is chosen is compared with nothing"
    assert "itself with 2 mm of noise, in hindsight | 4 |" in clearing_tables.of_methods(values, "heldout", "all")


def test_ends_are_counted_by_their_reason() -> None:
    ended = ["cleared", "pushed out", "pushed out", "fault"]
    tables = [lockstep.Outcome(str(i), why, 5, 4, 4, 6, 1) for i, why in enumerate(ended)]
    values = clearing_numbers._measured({"0": tables})
    found = {key: values[f"ended_{key}"] for key in ("pushed_out", "out_of_actions", "fault")}
    assert found == {"pushed_out": 2, "out_of_actions": 0, "fault": 1}
    assert values["completion"] == 0.25 and values["grasp_success_completed"] == 4 / 6
    nothing = clearing_numbers._measured({"0": tables[1:]})
    assert nothing["grasp_success_completed"] is None, "no table was cleared"


def test_of_two_tables_as_empty_the_one_with_fewer_actions_is_better() -> None:
    def one(removed: int, grasps: int, pushes: int) -> lockstep.Outcome:
        return lockstep.Outcome("01", "cleared", 5, removed, removed, grasps, pushes)

    pushed, alone = [one(5, 5, 2), one(5, 5, 0), one(4, 4, 0)], [one(5, 6, 0), one(5, 5, 1), one(5, 9, 0)]
    groups = {"table/hard/shipped/all/gn": {"0": alone}, "table/hard/shipped/all/dipn+gn+actions": {"0": pushed}}
    (better,) = clearing_numbers._hindsight(groups)["hindsight/hard"].values()
    assert better == [alone[0], pushed[1], alone[2]]
