"""Lists of runs: their order, which are skipped or made again, interruptions, the command line."""

import dataclasses
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from dipn_jax.errors import UserError
from dipn_jax.system import files, machine
from experiments import command, runs
from experiments.runs import Recipe, Run

ROOT = pathlib.Path(__file__).parent.parent.parent
FAKE = """
import json, pathlib, sys
out = pathlib.Path(sys.argv[-1])
with (out.parent / "log").open("a") as log:
    log.write(out.name + " ")
if (out.parent / f"break-{out.name}").exists():
    sys.exit(3)
(out / "config.json").write_text(json.dumps({"seed": 7}))
"""
"""A command that logs its folder's name, and fails if a file tells it to."""


@pytest.fixture
def fake(tmp_path: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """Return the first words of a command: Python and a script."""
    script = tmp_path / "fake.py"
    script.write_text(FAKE)
    return pathlib.Path(sys.executable), script


def _listed(fake: tuple[pathlib.Path, ...], folder: pathlib.Path, *, option: str = "--steps 1") -> list[Run]:
    """Return runs a to d: b needs a, c needs b, d needs nothing."""
    run = Recipe(folder)
    a = run("a", *fake, option)
    b = run("b", *fake, "--data", a)
    run("c", *fake, "--runs", [b])
    run("d", *fake)
    return run.runs


def _carry_out(listed: list[Run]) -> int:
    return runs.carry_out(listed, runs.keys(listed))


def test_a_failed_run_is_made_again_and_a_complete_one_is_not(fake, tmp_path: pathlib.Path, capfd) -> None:
    listed = _listed(fake, tmp_path)
    (tmp_path / "break-b").touch()
    assert _carry_out(listed) == 3
    assert (tmp_path / "log").read_text() == "a b "
    said = capfd.readouterr()
    assert "[1/4] a: " in said.out and "[2/4] b: " in said.out and "[3/4]" not in said.out
    assert said.err.startswith("error: b ended with exit code 3") and said.err.count("\n") == 1

    (tmp_path / "break-b").unlink()
    assert _carry_out(listed) == 0
    assert (tmp_path / "log").read_text() == "a b b c d "
    assert "[1/4] a: complete" in capfd.readouterr().out
    assert _carry_out(listed) == 0
    assert (tmp_path / "log").read_text() == "a b b c d "


def test_a_changed_command_and_the_runs_that_need_it_are_made_again(fake, tmp_path: pathlib.Path) -> None:
    assert _carry_out(_listed(fake, tmp_path)) == 0
    assert _carry_out(_listed(fake, tmp_path, option="--steps 2")) == 0
    assert (tmp_path / "log").read_text() == "a b c d a b c "


def test_a_selected_run_includes_the_runs_that_it_needs(fake, tmp_path: pathlib.Path) -> None:
    listed = _listed(fake, tmp_path)
    assert [run.name for run in runs.select(listed, ["c"])] == ["a", "b", "c"]
    assert [run.name for run in runs.select(listed, ["d", "a"])] == ["a", "d"]
    assert runs.select(listed, []) == listed
    under = [dataclasses.replace(run, name=f"{'x' if i < 2 else 'xy'}/{run.name}") for i, run in enumerate(listed)]
    assert runs.named(under, ["x", "xy/d"]) == ["x/a", "x/b", "xy/d"]
    with pytest.raises(UserError, match="--only e: no such run"):
        runs.select(listed, ["a", "e"])


def test_a_folder_inside_the_one_that_a_run_writes_is_of_that_run(tmp_path: pathlib.Path) -> None:
    run = Recipe(tmp_path)
    learnt = run("runs", "dipn-train sweep --seeds 0 1 -- push --data", tmp_path / "data")
    run("runs-2", "dipn-eval prediction --push-net", learnt / "seed-1")
    first, second = run.runs
    assert first.command[-4:] == ("--", "push", "--data", str(tmp_path / "data")) and "--out" in first.command
    assert runs.needs(second, run.runs) == [first] and not runs.needs(first, run.runs)
    with pytest.raises(UserError, match="runs: dipn-train does not take these arguments"):
        runs.parse(dataclasses.replace(first, command=(*first.command, "--bananas")))


def test_a_borrowed_run_is_the_same_run(fake, tmp_path: pathlib.Path) -> None:
    listed = _listed(fake, tmp_path / "first")
    run = Recipe(tmp_path / "second")
    assert run.borrow(listed, "b", prefix="first") == tmp_path / "first" / "b"
    assert [each.name for each in run.runs] == ["first/a", "first/b"]
    assert runs.keys(run.runs)["first/b"] == runs.keys(listed)["b"]


def test_a_stamp_names_machine_and_commit(fake, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run,) = _listed(fake, tmp_path)[:1]
    monkeypatch.setattr(machine, "commit", lambda: "abc")
    (tmp_path / "break-a").touch()
    assert _carry_out([run]) == 3
    assert runs.read_stamp(run)["complete"] is False
    (tmp_path / "break-a").unlink()
    monkeypatch.setattr(machine, "commit", lambda: "def")
    assert _carry_out([run]) == 0
    stamp = runs.read_stamp(run)
    assert stamp["complete"] is True and stamp["seed"] == 7 and stamp["command"] == run.line
    assert [made["commit"] for made in stamp["made_by"]] == ["abc", "def"]
    assert stamp["made_by"][0]["processor"] and stamp["made_by"][0]["cores"] >= 1

    (run.out / runs.STAMP).unlink()  # as if made before there were stamps
    assert _carry_out([run]) == 0
    assert [made["commit"] for made in runs.read_stamp(run)["made_by"]] == [runs.NOT_RECORDED, "def"]


def test_paths_stay_whole_and_texts_are_split() -> None:
    place = pathlib.Path("a folder")
    assert runs.words(["x --of 2", place, [place, place]]) == ("x", "--of", "2", *3 * ["a folder"])


def test_unknown_arguments_of_a_command_are_refused(tmp_path: pathlib.Path) -> None:
    run = Recipe(tmp_path)
    run("good", "dipn-datagen push --episodes 5 --density 100 200")
    run("bad", "dipn-datagen push --bananas 5")
    good, bad = run.runs
    parsed = runs.parse(good)
    assert parsed["episodes"] == 5 and parsed["ranges"].density == (100, 200) and parsed["out"] == good.out
    with pytest.raises(UserError, match="bad: dipn-datagen does not take"):
        runs.parse(bad)
    assert list(tmp_path.iterdir()) == []


def test_the_command_line(fake, tmp_path: pathlib.Path, capfd) -> None:
    pages: list[pathlib.Path] = []

    def call(*arguments: str) -> int:
        chosen = [*arguments, "--out", str(tmp_path / "out")]
        return command.main("x", "What.", lambda out: _listed(fake, out), page=pages.append, arguments=chosen)

    assert call("--only", "nowhere") == 2
    assert capfd.readouterr().err == "error: --only nowhere: no such run; --list shows their names\n"
    assert call("--list") == 0
    said = capfd.readouterr().out.splitlines()
    assert said[::2] == ["a", "b", "c", "d"] and said[3].endswith(f"--data {tmp_path}/out/a --out {tmp_path}/out/b")
    assert call("--dry-run") == 0
    assert capfd.readouterr().out.startswith("[1/4] a: ")
    assert not (tmp_path / "out").exists()

    assert call("--only", "b") == 0 and pages == []
    assert call("--dry-run", "--only", "b") == 0
    assert "[2/2] b: complete\n" in capfd.readouterr().out
    assert call() == 0 and pages == [tmp_path / "out"]
    assert (tmp_path / "out" / "log").read_text() == "a b c d "


SLOW = """
import pathlib, sys, time
out = pathlib.Path(sys.argv[-1])
if (out / "saved").exists():
    sys.exit(0)
interruptions = 0
(out / "begun").touch()
for _ in range(600):
    try:
        time.sleep(0.05)
        if interruptions:
            break
    except KeyboardInterrupt:
        interruptions += 1
(out / "saved").write_text(str(interruptions))
sys.exit(130)
"""
"""A command that works for half a minute and saves its state and how often it was interrupted."""

MAIN = """
import pathlib, sys
from experiments import command
from experiments.runs import Recipe

def listed(out):
    run = Recipe(out)
    run("slow", pathlib.Path(sys.executable), pathlib.Path(sys.argv[1]))
    return run.runs

sys.exit(command.main("x", "What.", listed, arguments=["--out", sys.argv[2]]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_command_saves_and_continues(tmp_path: pathlib.Path, number: int) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    words = [sys.executable, "-c", MAIN, str(tmp_path / "slow.py"), str(tmp_path)]
    begun = subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True)
    until = time.monotonic() + 60
    while not (tmp_path / "slow" / "begun").exists() and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(begun.pid, number)  # as a terminal does
    assert begun.communicate(timeout=60)[1].startswith("interrupted: ")
    assert begun.returncode == 130
    assert (tmp_path / "slow" / "saved").read_text() == "1"
    assert files.read_json(tmp_path / "slow" / runs.STAMP)["complete"] is False
    assert subprocess.run(words, cwd=ROOT, check=False).returncode == 0
    assert files.read_json(tmp_path / "slow" / runs.STAMP)["complete"] is True


def test_a_stamp_that_does_not_fit_is_one_line(tmp_path: pathlib.Path) -> None:
    run = Run("a", tmp_path, ("true",))
    runs.write_stamp(run, "key", complete=True)
    stamp = files.read_json(tmp_path / runs.STAMP)
    for wrong in ({"made_by": [1]}, {"complete": "yes"}, {"versions": []}):
        files.write_json(tmp_path / runs.STAMP, stamp | wrong)
        with pytest.raises(UserError, match=rf"stamp\.json: damaged, {next(iter(wrong))}"):
            runs.read_stamp(run)
