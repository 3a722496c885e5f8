"""Mutation testing: every module has tests of its own, and the page shows what was found."""

import contextlib
import pathlib
import sqlite3
import subprocess
import sys
from typing import Any

import pytest

from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments import mutants, mutants_session, pages

ROOT = pathlib.Path(__file__).parent.parent.parent


EQUIVALENT_MUTANTS = {
    # metrics: axes of arrays of two axes, and NumPy takes every negative number for "what is left"
    "return np.where(np.arange(sizes.max()) < sizes[chosen][..., None], pick, -1).reshape(RESAMPLES, - 2)",
    "return np.append(values, 0.0)[pick].sum(1)",
}
"""Mutants of `eval/metrics.py` and `eval/clearing/lockstep.py` that may survive; `docs/testing.md` says why."""


def _kept() -> dict[str, Any]:
    return files.read_json(ROOT / "docs" / "testing.json")


def test_modules_and_their_tests_exist() -> None:
    for module, tests in mutants.TESTS.items():
        assert (ROOT / module).is_file() and tests, module
        assert all((ROOT / name).is_file() for name in tests), module
    wanted = ("metrics", "planner", "candidates", "imagine", "losses", "records", "scenes", "split", "lockstep")
    assert set(wanted) <= {pathlib.Path(module).stem for module in mutants.TESTS}


def test_the_section_in_docs_is_that_of_the_kept_numbers() -> None:
    text, values = (ROOT / "docs" / "testing.md").read_text(), _kept()
    assert set(values) <= set(mutants.TESTS)
    assert pages.with_tables(text, mutants.section(values)) == text
    assert pages.with_box(text, mutants.box(values)) == text
    for found in values.values():
        assert found["mutants"] == found["killed"] + len(found["survivors"])


def test_every_survivor_is_explained() -> None:
    text = (ROOT / "docs" / "testing.md").read_text()
    for module, found in _kept().items():
        own = text.partition(f"### {module}\n")[2].partition("\n### ")[0]
        for each in found["survivors"]:
            assert f"`{each['became']}`" in own, f"{module}: {each}"


def test_no_survivor_counts_or_ends_a_table_or_computes_an_interval() -> None:
    values = _kept()
    for module in ("eval/metrics.py", "eval/clearing/lockstep.py"):
        survivors = values.get(module, {"survivors": []})["survivors"]
        assert {each["became"] for each in survivors} <= EQUIVALENT_MUTANTS, module


def test_a_dry_run_shows_the_tests_of_a_module(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert mutants.main(["--dry-run", "--only", "eval/metrics.py", "--out", str(out)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("eval/metrics.py: ") and line.endswith(" ".join(mutants.TESTS["eval/metrics.py"]))
    assert " -m pytest -x " in line and not out.exists()
    assert mutants.main(["--list"]) == 0
    assert capsys.readouterr().out.count("\n  tests/") == len(mutants.TESTS)
    assert mutants.main(["--only", "eval/nothing.py"]) == 2
    assert "eval/nothing.py" in capsys.readouterr().err


def test_the_table_has_the_measured_modules_and_a_sentence_the_others() -> None:
    found = {"mutants": 8, "killed": 7, "survivors": [{"became": "x"}]}
    first, table, others = mutants.section({"train/split.py": found}).split("\n\n")
    assert first == f"1 of {len(mutants.TESTS)} modules are measured: 7 of 8 mutants killed (87.5 %)."
    assert table.splitlines()[2:] == ["| `train/split.py` | 8 | 7 (87.5 %) | 1 |"]
    assert others.startswith("Not measured yet: `eval/metrics.py`, ") and "train/split.py" not in others
    assert others.count("`") == 2 * (len(mutants.TESTS) - 1) and max(map(len, others.splitlines())) <= 120
    assert "Not measured" not in mutants.section(dict.fromkeys(mutants.TESTS, found))


def test_the_box_has_the_commit_of_every_module() -> None:
    found = {"a.py": {"commit": "1"}, "b.py": {"commit": "2"}, "c.py": {"commit": "1"}}
    assert mutants.box(found).splitlines() == ["```", "commit 1: a.py, c.py", "commit 2: b.py", "```"]


def test_annotations_are_found_and_nothing_else() -> None:
    source = "def f(a: int | None = 1 | 2) -> int | str:\n    b: int | None = 3 | 4\n    return b\n"
    lines = source.splitlines()
    found = sorted(lines[row - 1][begin:end] for (row, begin), (_, end) in mutants_session.left_alone(source))
    assert found == ["int | None", "int | None", "int | str"]


def test_arguments_that_guard_are_left_alone() -> None:
    source = "for a in zip(b, c, strict=True):\n    d(frozen=True, other=True)\n"
    found = [(begin, end) for begin, end in mutants_session.left_alone(source)]
    assert sorted(found) == [((1, 26), (1, 30)), ((2, 13), (2, 17))]


def test_the_changed_line_of_a_diff() -> None:
    diff = "--- mutation diff ---\n--- a/x.py\n+++ b/x.py\n@@ -1 +1 @@\n-    return 1 + 2\n+    return 1 - 2"
    assert mutants_session.changed(diff) == ("return 1 + 2", "return 1 - 2")


def test_only_survivors_are_run_again_when_tests_have_changed(tmp_path: pathlib.Path) -> None:
    with sqlite3.connect(tmp_path / "x.sqlite") as database:
        database.execute("CREATE TABLE work_results (job_id, test_outcome)")
        database.executemany(
            "INSERT INTO work_results VALUES (?, ?)", [("a", "KILLED"), ("b", "SURVIVED"), ("c", None)]
        )
    mutants_session._forget_survivors(tmp_path / "x.sqlite")
    with sqlite3.connect(tmp_path / "x.sqlite") as database:
        assert [row[0] for row in database.execute("SELECT job_id FROM work_results")] == ["a", "c"]


def test_a_changed_module_begins_a_new_session(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cosmic_ray")
    session, module = tmp_path / "x.sqlite", tmp_path / "module.py"
    begun: list[bool] = []

    def began(*_: object) -> None:
        begun.append(session.exists())
        session.touch()

    monkeypatch.setattr(mutants_session, "_python", began)
    monkeypatch.setattr(mutants_session, "_skip", lambda *_: None)
    monkeypatch.setattr("cosmic_ray.work_db.use_db", lambda _: contextlib.nullcontext())
    for text in ("one", "one", "two"):
        module.write_text(text)
        mutants_session._prepare(tmp_path, tmp_path / "config", session, "module.py", [])
    assert begun == [False, False], "once for each text, without what the other one left"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("from module import X\ndef test_it() -> None:\n    assert X == 1\n", None),
        ("from module import X\ndef test_it() -> None:\n    assert X == 2\n", "fail without mutation"),
        ("def test_it() -> None:\n    assert True\n", "pass though it cannot be imported"),
    ],
)
def test_tests_that_say_nothing_of_a_module_are_refused(tmp_path: pathlib.Path, text: str, said: str | None) -> None:
    (tmp_path / "module.py").write_text("X = 1\n")
    (tmp_path / "test_module.py").write_text(text)
    if said:
        with pytest.raises(UserError, match=said):
            mutants_session._check(tmp_path, "module.py", ["test_module.py"])
    else:
        assert mutants_session._check(tmp_path, "module.py", ["test_module.py"]) > 0
        assert (tmp_path / "module.py").read_text() == "X = 1\n"


@pytest.mark.slow
def test_a_mutant_is_killed_by_a_failure_and_by_time(tmp_path: pathlib.Path) -> None:
    for name, body in (("good", "assert True"), ("bad", "assert False"), ("endless", "while True: pass")):
        (tmp_path / f"test_{name}.py").write_text(f"def test_it() -> None:\n    {body}\n")
    script = (
        "from experiments.mutants_exec import run_tests\n"
        "for name in ('good', 'bad', 'endless'):\n"
        f"    print(run_tests(f'python -m pytest {tmp_path}/test_{{name}}.py', 5)[0])\n"
    )
    command = [sys.executable, "-c", script]
    said = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    assert said.split() == ["survived", "killed", "killed"]
