"""Whatever is in a file, its parser accepts it or refuses it with one line; and the experiment counts just that."""

import json
import pathlib
import random
from typing import Any

import hypothesis
import pytest
from hypothesis import strategies as st

from dipn_jax.errors import UserError
from dipn_jax.storage import layout
from dipn_jax.system import typed
from experiments import fuzz, fuzz_parsers, fuzzing
from experiments.fuzz_parsers import PARSERS, Parser

SETTINGS = hypothesis.settings(derandomize=True, deadline=None, max_examples=30, database=None)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters()),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)
"""JSON values, and numbers that JSON has not."""


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[pathlib.Path, bytes]]:
    """Return a folder for each parser, and its valid file."""
    found = {}
    for name, parser in PARSERS.items():
        folder = tmp_path_factory.mktemp("fuzz")
        parser.prepare(folder)
        found[name] = (folder, (folder / parser.file).read_bytes())
    return found


@pytest.mark.parametrize("name", PARSERS)
@SETTINGS
@hypothesis.given(draw=st.randoms(use_true_random=False))
def test_what_is_damaged_is_accepted_or_refused_with_one_line(
    name: str, draw: random.Random, prepared: dict[str, tuple[pathlib.Path, bytes]]
) -> None:
    folder, valid = prepared[name]
    (folder / PARSERS[name].file).write_bytes(PARSERS[name].mutate(draw, valid))
    kind, said = fuzz.outcome(PARSERS[name], folder)
    assert kind in ("accepted", "refused"), said


@pytest.mark.parametrize("name", PARSERS)
def test_what_is_whole_is_accepted(name: str, prepared: dict[str, tuple[pathlib.Path, bytes]]) -> None:
    folder, valid = prepared[name]
    (folder / PARSERS[name].file).write_bytes(valid)
    assert fuzz.outcome(PARSERS[name], folder)[0] == "accepted"


@SETTINGS
@hypothesis.given(value=VALUES)
def test_any_value_is_of_a_form_or_misfits_in_one_line(value: Any) -> None:
    for form in (layout.META, {str: typed.Maybe(float)}, [VALUES_FORM], (int, str), {"push"}, typed.Whole(3, 9)):
        try:
            assert typed.check(value, form) is value
        except typed.Misfit as error:
            assert "\n" not in str(error) and str(error).encode()


VALUES_FORM = {"a": int, "b?": [str]}


@SETTINGS
@hypothesis.given(value=VALUES)
def test_any_text_of_json_is_parsed_or_misfits(value: Any) -> None:
    text = json.dumps(value)
    try:
        assert typed.parse(text) == value
    except typed.Misfit:
        assert any(name in text for name in ("NaN", "Infinity"))


@pytest.mark.parametrize("kind", ["push", "grasp", "images"])
def test_a_shard_of_every_kind_is_whole(kind: str, tmp_path: pathlib.Path) -> None:
    from dipn_jax.storage import records

    fuzz_parsers.data_set(tmp_path, kind=kind)
    assert len(records.load(tmp_path, kind=kind)[0].fault) == 4


def _parser(read: Any) -> Parser:
    def prepare(folder: pathlib.Path) -> None:
        (folder / "a.json").write_text("[1]")

    return Parser("a", "a.json", prepare, read, fuzzing.mutate_json)


def test_outcomes_are_counted_as_they_are(tmp_path: pathlib.Path) -> None:
    def read(folder: pathlib.Path) -> None:
        text = (folder / "a.json").read_bytes()
        if text != b"[1]":
            if b"2" in text:
                raise UserError("two lines\nof text")
            if b"1" in text:
                raise KeyError("x")
            raise UserError("one line")

    found = fuzz.fuzz(_parser(read), 200, tmp_path)
    assert sum(found.outcomes.values()) == 200 and found.outcomes["tracebacks"] > 0 and found.outcomes["refused"] > 0
    assert any("KeyError: 'x'" in each for each in found.failures)
    assert found.outcomes == fuzz.fuzz(_parser(read), 200, tmp_path).outcomes, "seeded"
    with pytest.raises(RuntimeError, match="its valid file is not accepted"):
        fuzz.fuzz(_parser(lambda folder: [][0]), 1, tmp_path)


def test_counts_stand_in_the_file_of_results_beside_others(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "reliability.json"
    path.write_text(
        '{"faults": {"a": 1}, "fuzz": {"stamp": {"inputs": 3, "accepted": 1, "refused": 2, "tracebacks": 0}}}'
    )
    assert fuzz.main(["--only", "log", "--inputs", "20", "--results", str(path)]) == 0
    found = json.loads(path.read_text())
    assert found["faults"] == {"a": 1} and list(found["fuzz"]) == ["log", "stamp"]
    counts = found["fuzz"]["log"]
    assert counts["inputs"] == 20 == counts["accepted"] + counts["refused"] and counts["tracebacks"] == 0
    assert counts["commit"] and counts["seed"] == 0
    assert f"| log | 20 | {counts['accepted']} | {counts['refused']} | 0 |" in capsys.readouterr().out
    assert fuzz.main(["--dry-run", "--only", "log"]) == 0
    assert capsys.readouterr().out == "log: 10000 mutations of metrics.jsonl\n"
    assert fuzz.main(["--only", "nothing", "--results", str(path)]) == 2
    assert "--only nothing: no such parser" in capsys.readouterr().err
