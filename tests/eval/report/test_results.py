"""Rows that are compared with one of them, table by table, from results made by hand."""

import dataclasses
import pathlib
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval import cli, metrics
from dipn_jax.eval.clearing import lockstep
from dipn_jax.eval.report import results
from dipn_jax.eval.report.cleared import Cleared
from dipn_jax.eval.report.results import Results

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files

RECORDED = {
    "tables.cases": "hard", "tables.objects": "10", "tables.names": [], "tables.instances": 2,
    "tables.as_placed": False, "seed": 0, "files": {"/a/hard_cases.json": "ab"},
}  # fmt: skip
"""What settings record of tables."""
CASES = ("01", "01", "02", "02", "03", "03", "04", "04", "05", "05")
BETTER, WORSE, MIXED = (6, 6, 7, 6, 7) * 2, (9, 10, 9, 8, 10) * 2, (6, 12, 12, 6, 6, 12, 6, 6, 12, 12)
"""Actions on each of ten tables of five objects."""
COLUMN = "efficiency all, points from gn"


def _row(
    folder: pathlib.Path, method: str, actions: tuple[int, ...] = WORSE, label: str = "", **changed: Any
) -> Cleared:
    """Write what `dipn-eval clear` writes of tables of five objects, but the films; read it. None: not recorded."""
    tables = [
        lockstep.Outcome(name, "cleared", objects=5, removed=5, held=5, grasps=5, pushes=count - 5)
        for name, count in zip(CASES, actions, strict=False)
    ]
    folder = folder / (method + label)
    settings = RECORDED | {"method": method, "label": label} | changed
    recorded = {name: value for name, value in settings.items() if value is not None}
    metrics.write(folder, lockstep.summary(tables), settings=recorded)
    entries = [dataclasses.asdict(table) | {"file": "episodes/000.npz"} for table in tables]
    files.write_json(folder / "episodes.json", entries)
    return Cleared(folder)


def _column(found: Results) -> dict[str, str]:
    head, lines = found.cells()
    assert head[-1] == COLUMN and {len(line) for line in lines} == {len(head)}
    return {line[0]: line[-1] for line in lines}


def test_a_row_is_ahead_or_behind_only_where_the_interval_excludes_zero(tmp_path: pathlib.Path) -> None:
    rows = [_row(tmp_path, method, actions) for method, actions in (("dipn+gn", BETTER), ("gn", WORSE), ("vpg", MIXED))]
    (found,) = results.grouped(rows, against="gn")
    told = _column(found)
    points = 100 * (50 / sum(BETTER) - 50 / sum(WORSE))
    assert told["dipn+gn"].startswith(f"{points:+.1f} [+") and told["dipn+gn"].endswith("] ahead")
    assert told["gn"] == "" and told["dipn+gn, the paper"] == ""
    assert told["vpg"].startswith(f"{100 * (50 / sum(MIXED) - 50 / sum(WORSE)):+.1f} [-") and told["vpg"].endswith("]")
    (other,) = results.grouped(rows, against="dipn+gn")
    assert other.cells()[1][1][-1].startswith(f"{-points:+.1f} [-") and other.cells()[1][1][-1].endswith("] behind")


def test_differences_are_those_of_the_measure_paired_by_table_and_grouped_by_case(tmp_path: pathlib.Path) -> None:
    rows = [_row(tmp_path, "gn"), _row(tmp_path, "vpg", MIXED, label="more")]
    values = results.differences(results.grouped(rows, against="gn"))
    removed = np.full(10, 5)
    wanted = metrics.ratio_difference((removed, np.array(MIXED)), (removed, np.array(WORSE)), CASES)
    at = "clear/hard/more/vpg/efficiency_all_difference"
    assert values == dict(zip((at, f"{at}_low", f"{at}_high"), wanted, strict=True))
    assert values[at] == pytest.approx(rows[1].values["efficiency_all"] - rows[0].values["efficiency_all"])
    ungrouped = metrics.ratio_difference((removed, np.array(MIXED)), (removed, np.array(WORSE)), range(10))
    assert wanted != ungrouped, "the test would not notice other groups"


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"tables.names": ["01", "02", "03", "04", "05"]},
        {"files": {"/a/hard_cases.json": "cd"}},
        {"seed": None},
    ],
)
def test_a_row_of_other_tables_is_not_compared(other: dict[str, Any], tmp_path: pathlib.Path) -> None:
    rows = [_row(tmp_path, "gn"), _row(tmp_path, "vpg", BETTER, **other)]
    (found,) = results.grouped(rows, against="gn")
    assert _column(found)["vpg"] == "-"
    assert found.notes()[-1] == "Of other tables than gn, so not compared: vpg."
    assert set(results.differences([found]).values()) == {None}


def test_a_row_whose_list_of_tables_differs_is_not_compared(tmp_path: pathlib.Path) -> None:
    rows = [_row(tmp_path, "gn"), _row(tmp_path, "vpg", BETTER[:4])]
    assert _column(results.grouped(rows, against="gn")[0])["vpg"] == "-"


def test_of_a_single_table_nothing_is_said_to_be_sure(tmp_path: pathlib.Path) -> None:
    rows = [_row(tmp_path, "gn", WORSE[:1]), _row(tmp_path, "vpg", BETTER[:1])]
    (found,) = results.grouped(rows, against="gn")
    assert _column(found)["vpg"] == f"{100 * (5 / 6 - 5 / 9):+.1f}"
    at = "clear/hard/vpg/efficiency_all_difference"
    assert results.differences([found]) == {
        at: pytest.approx(5 / 6 - 5 / 9), f"{at}_low": None, f"{at}_high": None,
    }  # fmt: skip


def test_a_row_is_called_by_its_method_its_label_or_both(tmp_path: pathlib.Path) -> None:
    bare, gn = _row(tmp_path, "gn", label="bare"), _row(tmp_path, "gn")
    own, vpg = _row(tmp_path, "vpg", label="own"), _row(tmp_path, "vpg", label="other")
    rows = [bare, gn, own, vpg]
    for against, row in (("gn", gn), ("bare", bare), ("gn (bare)", bare), ("own", own), ("vpg (other)", vpg)):
        assert results.grouped(rows, against=against)[0].rival is row
    assert results.grouped(rows)[0].rival is None
    assert results.grouped([bare, own], against="gn")[0].rival is bare
    with pytest.raises(
        UserError, match=r"--against vpg: on hard these are called so: vpg \(own\), vpg \(other\); give"
    ):
        results.grouped(rows, against="vpg")
    with pytest.raises(
        UserError, match=r"--against dqn: no row is called so; want one of: gn \(bare\), gn, vpg \(own\)"
    ):
        results.grouped(rows, against="dqn")


def test_where_no_row_is_called_so_nothing_is_compared(tmp_path: pathlib.Path) -> None:
    rows = [_row(tmp_path, "gn"), _row(tmp_path, "vpg", label="x", **{"tables.cases": "heldout"})]
    first, second = results.grouped(rows, against="gn")
    assert (first.tables, second.tables) == ("hard", "heldout")
    assert COLUMN in first.cells()[0] and COLUMN not in second.cells()[0]
    assert second.notes()[-1] == "No row here is gn, so nothing is compared."
    assert not any("Points from" in note for note in first.notes()), "there is no other row"
    assert results.differences([first, second]) == {}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--runs", "x", "--against", "gn"], "--against gn: compares cleared tables; give their folders with --clear"),
        (["--clear", "gn", "--against", "vpg"], "--against vpg: no row is called so; want one of: gn"),
    ],
)
def test_a_comparison_with_nothing_is_one_line(
    words: list[str], says: str, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    _row(tmp_path, "gn")
    words = [str(tmp_path / word) if word == "gn" and words[0] == "--clear" else word for word in words]
    assert console.run("test", cli.COMMANDS, ["report", *words, "--out", str(tmp_path / "out")]) == 2
    assert capfd.readouterr().err == f"error: {says}\n"
    assert not (tmp_path / "out").exists()


def test_a_difference_is_ahead_or_behind_only_where_its_interval_has_a_width_and_excludes_zero() -> None:
    told = {(0.1, 0.02, 0.2): "ahead", (-0.1, -0.2, -0.02): "behind", (0.1, -0.1, 0.2): "", (0.1, 0.1, 0.1): ""}
    for difference, word in told.items():
        assert results._told(difference).rpartition("]")[2].strip() == word
