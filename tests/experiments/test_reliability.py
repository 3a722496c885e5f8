"""The page of what runs survive: its tests exist, its tables are those of the kept counts, and damage is counted."""

import ast
import pathlib
import re
import shutil

import pytest

from dipn_jax.system import files
from experiments import pages, promises, reliability

ROOT = pathlib.Path(__file__).parent.parent.parent
VALUES = {
    "faults": {
        "made": {key: {"commit": "abc", "processor": "Some"} for key in ("push", "clear")},
        "push": {"killed": {"tried": 3, "lost": 1, "repeated": 0, "wrong": 1, "damaged": 0, "tracebacks": 0}},
        "clear": {"killed": {"tried": 4, "lost": 0, "repeated": 2, "wrong": 0, "damaged": 0, "tracebacks": 0}},
    },
    "fuzz": {
        "shard": {"inputs": 1000, "tracebacks": 1, "seed": 0, "commit": "def"},
        "meta": {"inputs": 500, "tracebacks": 0, "seed": 0, "commit": "abc"},
    },
    "checkpoints": {"damaged": 8, "recovered": 7, "commit": "ghi", "processor": "Other"},
}


def _kept() -> dict[str, object]:
    return files.read_json(ROOT / "docs" / "reliability.json")


def test_every_test_that_the_page_names_exists() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "docs" / "reliability.md").read_text())
    assert len(named) > 15
    for file, name in named:
        tree = ast.parse((ROOT / file).read_text())
        assert name in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)], f"{file}::{name}"


def test_the_section_in_docs_is_that_of_the_kept_counts() -> None:
    text = (ROOT / "docs" / "reliability.md").read_text()
    assert pages.with_tables(text, reliability.section(_kept())) == text
    assert pages.with_box(text, reliability.box(_kept())) == text


def test_the_box_says_of_every_count_how_it_was_made() -> None:
    lines = reliability.box(VALUES).splitlines()[1:-1]
    assert lines[:2] == ["shard: commit def, seed 0", "meta: commit abc, seed 0"]
    assert lines[2:] == ["faults: commit abc, Some", "damaged: commit ghi, Other"]
    made = VALUES["faults"]["made"] | {"clear": {"commit": "abd", "processor": "Some"}}
    lines = reliability.box({"faults": {"made": made}}).splitlines()[1:-1]
    assert lines == ["push: commit abc, Some", "clear: commit abd, Some"]
    alike = {name: found | {"commit": "abc"} for name, found in VALUES["fuzz"].items()}
    assert reliability.box({"fuzz": alike}).splitlines()[1:-1] == ["inputs: commit abc, seed 0"]


def test_the_counts_of_all_commands_are_added() -> None:
    text = " ".join(reliability.section(VALUES).split())
    said = "7 faults: 1 records lost, 2 repeated, 1 results wrong, 0 files damaged, 0 tracebacks"
    assert text.count(said) == 2 and text.count("1,500 damaged inputs: 1 tracebacks") == 2
    assert (
        text.count("8 damaged checkpoints: 7 runs continued") == 2
        and "| clear | killed | 4 | 0 | 2 | 0 | 0 | 0 |" in text
    )
    assert reliability.section({}).count("Tried: not run.") == 3


def test_every_promise_is_a_paragraph_of_short_lines() -> None:
    lines = reliability.section(VALUES).splitlines()
    assert max(map(len, lines)) <= 120
    paragraphs = "\n".join(lines).split("\n\n")
    held = [each for each in paragraphs if " ".join(each.split()).startswith("Held by `tests/")]
    assert len(held) == len(promises.PROMISES) == sum(each.startswith("**") for each in paragraphs)
    assert sum(each.count("`") for each in held) == 2 * sum(len(each.tests) for each in promises.PROMISES)


def test_what_an_experiment_found_is_put_beside_what_others_found(tmp_path: pathlib.Path) -> None:
    shutil.copy(ROOT / "docs" / "reliability.md", tmp_path)
    for key in VALUES:
        reliability.write(key, VALUES[key], docs=tmp_path)
    assert files.read_json(tmp_path / "reliability.json") == VALUES
    assert reliability.section(VALUES) in (tmp_path / "reliability.md").read_text()


def test_faults_of_a_command_are_put_beside_those_of_others(tmp_path: pathlib.Path) -> None:
    shutil.copy(ROOT / "docs" / "reliability.md", tmp_path)
    for key in VALUES:
        reliability.write(key, VALUES[key], docs=tmp_path)
    rows, made = {"killed": VALUES["faults"]["push"]["killed"] | {"tried": 9}}, {"commit": "new", "processor": "Some"}
    reliability.write_faults({"push": rows, "merge": rows}, made, known=["push", "merge"], docs=tmp_path)
    found = files.read_json(tmp_path / "reliability.json")["faults"]
    assert found == {"push": rows, "merge": rows, "made": {"push": made, "merge": made}}, (
        "clear is none of ours any more"
    )
    reliability.write_faults({"clear": rows}, made | {"commit": "newer"}, known=["push", "clear"], docs=tmp_path)
    found = files.read_json(tmp_path / "reliability.json")["faults"]
    assert found["push"] == found["clear"] == rows and found["made"]["push"] == made
    text = (tmp_path / "reliability.md").read_text()
    assert "\npush: commit new, Some\nclear: commit newer, Some\n" in text


def test_every_kind_of_damage_is_noticed(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    reliability.two_steps(tmp_path)
    found = reliability.damage(tmp_path, ["a bit flipped", "deleted"])
    assert found["damaged"] == found["recovered"] > 10
    assert "damaged; step 1 of" in capsys.readouterr().err
