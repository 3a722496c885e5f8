"""Faults: they are spread over all calls, counted rightly, and a few of them are tried here."""

import os
import pathlib

import numpy as np
import pytest
from dipn_jax.datagen.exporting.export import export

from dipn_jax.storage import shards
from dipn_jax.system import files
from experiments import faults, faults_found, faults_run
from experiments.faults_found import Result
from experiments.faults_run import Case, Point

SMALL = Case("generate", (*faults.CASES[0].words[:2], "--episodes", "2", "--shard-size", "1", *faults._SMALL_SCENES))


def test_faults_are_spread_over_all_calls_of_every_command() -> None:
    counts = {("a", "killed"): 3, ("a", "full"): 100, ("b", "killed"): 0, ("c", "killed"): 3, ("c", "full"): 9}
    totals = {"a": 13, "b": 5, "c": 3}
    points = faults.spread(counts, totals)
    assert points == faults.spread(counts, totals) and len(set(points)) == 16
    few = [(point.kind, point.when) for point in points if point.case == "c"]
    assert few == [("killed", 1), ("full", 5), ("killed", 3)]
    points = [point for point in points if point.case == "a"]
    by_kind = [sorted(point.when for point in points if point.kind == kind) for kind in ("killed", "full")]
    assert by_kind[0] == [1, 2, 3] and by_kind[1][0] == 1 and by_kind[1][-1] == 100
    assert np.diff(by_kind[1]).max() <= 12
    assert {point.kind for point in points[:2]} == {"killed", "full"}, "the first few are of all kinds"
    assert len(set(faults.spread(counts, dict.fromkeys("abc", 1000)))) == 115


def test_lost_and_repeated_records_are_counted() -> None:
    whole = Result(["a", "b", "b"], {"x": "1"})
    assert faults_found.compare(whole, whole) == {"lost": 0, "repeated": 0, "wrong": 0}
    assert faults_found.compare(Result(["a", "a", "a", "b"], {"x": "2"}), whole) == {
        "lost": 1,
        "repeated": 2,
        "wrong": 1,
    }
    assert faults_found.compare(Result([], {"x": "1"}), whole) == {"lost": 3, "repeated": 0, "wrong": 0}


def test_counts_are_added_by_command_and_kind() -> None:
    none = dict.fromkeys(faults.COUNTED, 0)
    tried = [{"case": "a", "kind": "k", "reached": reached, **none, "lost": 2} for reached in (1, 0, 1)]
    assert faults.summary(tried) == {"a": {"k": {"tried": 2, **none, "lost": 6}}}


def test_a_fault_that_is_not_reached_is_tried_nearer(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def attempt(point: Point, *_: object, **__: object) -> dict[str, object]:
        tried.append(point.when)
        none = dict.fromkeys(faults.COUNTED, 0)
        return {"reached": int(point.when <= 5), **none, "wrong": int(point.when == 7), "codes": [-9, 0]}

    monkeypatch.setattr(faults_run, "attempt", attempt)
    monkeypatch.setattr(faults_run, "reference", lambda *_: Result([], {}))
    (tmp_path / "points").mkdir()
    kind, listed = "killed at a write", [Point("generate", "killed at a write", when) for when in (9, 10)]
    faults._try(listed[0], SMALL, tmp_path, "these", listed=listed)
    faults._try(listed[0], SMALL, tmp_path, "these", listed=listed)  # it has been tried with these sources
    assert tried == [9, 7, 5]
    (kept,) = (tmp_path / "points").iterdir()
    found = files.read_json(kept)
    assert (found["when"], found["reached"], found["wrong"]) == (5, 1, 1), (
        "a wrong result of a try that was not reached is counted, too"
    )
    faults._try(listed[1], SMALL, tmp_path, "these", listed=listed)
    assert tried == [9, 7, 5, 10, 8, 4], "5 has been tried"
    assert faults.nearer(Point("generate", kind, 1), listed) == []
    assert [each.when for each in faults.nearer(Point("generate", kind, 3), {Point("generate", kind, 3)})] == [2, 1]


def test_a_file_that_is_not_whole_is_noticed(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    whole = faults_found.result(data["push"])
    assert len(whole.records) == len(set(whole.records)) == 24 and "shard-00001.parquet" in whole.digests
    path = shards.shard_path(tmp_path, 1)
    path.write_bytes(shards.shard_path(data["push"], 1).read_bytes())
    (tmp_path / ".shard-00000.parquet.1-a.tmp").write_bytes(b"half")
    assert faults_found.damaged(tmp_path, whole) == []
    path.write_bytes(path.read_bytes()[:-1])
    (tmp_path / "manifest.json").write_text('{"shards')
    assert faults_found.damaged(tmp_path, whole) == [path.name, "manifest.json"]


@pytest.mark.parametrize("form", ["parquet", "zarr", "lerobot"])
def test_every_episode_of_an_export_is_a_record(
    form: str, data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    out = tmp_path / "out"
    export(data["push"], out, form=form, images="none", command=[])
    whole = faults_found.result(out)
    steps = 11 if form == "lerobot" else 1
    assert len(whole.records) == len(set(whole.records)) == 24 * steps and "README.md" in whole.digests
    path = next(path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "config.json")
    (out / ".left.tmp").write_bytes(path.read_bytes())
    assert faults_found.damaged(out, whole) == []
    assert faults_found.compare(faults_found.result(out), whole) == {"lost": 0, "repeated": 0, "wrong": 1}
    (out / "README.md").write_text("half")
    assert faults_found.damaged(out, whole) == ["README.md"]


def test_a_source_that_a_command_changes_is_damaged_and_the_result_wrong(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, whole = Case("merge", ("dipn-datagen", "merge"), (("one", ()), ("two", ()))), Result(["a"], {})
    for name in ("one", "two"):
        files.write_text(tmp_path / "data" / name / "shard", "whole")

    def run(*_: object, **__: object) -> tuple[int, str]:
        (tmp_path / "data" / "two" / "shard").write_text("half")
        return 0, ""

    monkeypatch.setattr(faults_run, "run", run)
    monkeypatch.setattr(faults_found, "result", lambda _: whole)
    (tmp_path / "trace").touch()
    point = Point("merge", "killed at a write", 1)
    found = faults_run.attempt(point, case, faults.KINDS[point.kind], whole, out=tmp_path)
    assert (found["damaged"], found["wrong"], found["torn"]) == (1, 1, ["two/shard"])
    found = faults_run.attempt(point, case, faults.KINDS[point.kind], whole, out=tmp_path)
    assert (found["damaged"], found["wrong"]) == (0, 0)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return a folder of the experiment that shares the tests' compiled programs."""
    if reason := faults_run.can_trace():
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("faults")
    (folder / "cache").mkdir()
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    (folder / "cache" / "dipn-jax").symlink_to(pathlib.Path(home) / "dipn-jax")
    return folder


@pytest.mark.parametrize(
    ("kind", "when"),
    [
        ("killed at a rename", 3),
        *(
            pytest.param(kind, 4, marks=pytest.mark.slow)
            for kind in ("killed at a write", "killed at a sync", "disk full at a sync")
        ),
    ],
)
def test_a_command_given_again_after_a_fault_ends_as_an_undisturbed_one(
    kind: str, when: int, out: pathlib.Path
) -> None:
    whole = faults_run.reference(SMALL, out)
    assert len(whole.records) == 2
    found = faults_run.attempt(Point("generate", kind, when), SMALL, faults.KINDS[kind], whole, out=out)
    assert found["reached"] and found["codes"] == ([2, 0] if "full" in kind else [-9, 0]), found
    assert not any(found[name] for name in faults.COUNTED), found


def test_a_dry_run_lists_commands_and_kinds(capsys: pytest.CaptureFixture[str], tmp_path: pathlib.Path) -> None:
    assert faults.main(["--dry-run", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.count("\n") == len(faults.CASES) + len(faults.KINDS)
    assert list(tmp_path.iterdir()) == []
