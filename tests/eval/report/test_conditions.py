"""In what the rows of a table of results differ, beside method and label."""

import dataclasses
import pathlib
from typing import Any

import pytest
from dipn_jax.eval import metrics, options
from dipn_jax.eval.clearing import evaluation
from dipn_jax.eval.clearing.camera import Camera
from dipn_jax.eval.clearing.tables import Tables
from dipn_jax.eval.report import cleared, conditions
from dipn_jax.eval.report.conditions import Conditions

from dipn_jax.errors import UserError
from dipn_jax.system import files
from dipn_jax.world.ranges import Ranges
from experiments.fuzz_parsers import PARSERS

DIGEST = "0123456789abcdef" * 4


def _settings(tables: Tables, camera: Camera | None = None, **changed: Any) -> dict[str, Any]:
    """Return what `dipn-eval clear` records of its options, as JSON has it."""
    given = {"tables": tables, "camera": camera or Camera(), "seed": 1_000_000, "engine": "auto"} | changed
    recorded = {key: options.as_json(value) for key, value in evaluation.settings(given).items()}
    return recorded | {"files": {} if tables.cases == "random" else {"/a/cases.json": DIGEST}}


def _read(*given: Any, **changed: Any) -> Conditions:
    return conditions.read(_settings(*given, **changed))


def test_rows_of_equal_tables_are_said_to_be_made_with_their_options() -> None:
    one, other = _read(Tables("hard", instances=10)), _read(Tables("hard", instances=10))
    assert one.same_tables(other)
    assert conditions.notes({"gn": one, "dipn+gn": other}) == [
        "All rows: --instances 10, --seed 1000000, --masks found, --engine auto."
    ]
    packed = _read(Tables("random", instances=3, ranges=Ranges(packed=1.0)))
    assert conditions.notes({"gn": packed}) == [
        "All rows: --objects 10, --instances 3, --seed 1000000, --packed 1, --engine auto, --masks found."
    ]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (_read(Tables("hard"), seed=7), "--seed 1000000 (gn, vpg), 7 (dipn+gn)"),
        (_read(Tables("hard", instances=2)), "--instances 1 (gn, vpg), 2 (dipn+gn)"),
        (_read(Tables("hard", names=("01", "02"))), "--names all (gn, vpg), 01 02 (dipn+gn)"),
        (_read(Tables("hard", as_placed=True)), "--as-placed no (gn, vpg), yes (dipn+gn)"),
        (
            conditions.read(_settings(Tables("hard")) | {"files": {"/b": "f" * 64}}),
            "case file 0123456789ab (gn, vpg), ffffffffffff (dipn+gn)",
        ),
    ],
)
def test_rows_of_other_tables_are_named_with_the_option(changed: Conditions, says: str) -> None:
    one = _read(Tables("hard"))
    assert not one.same_tables(changed) and not changed.same_tables(one)
    notes = conditions.notes({"gn": one, "dipn+gn": changed, "vpg": one})
    assert notes[1:] == [f"Rows of different tables: {says}."]
    assert says.split()[0] not in notes[0]


@pytest.mark.parametrize("field", dataclasses.fields(Ranges), ids=lambda field: field.name)
def test_random_tables_of_other_ranges_are_other_tables(field: dataclasses.Field[Any]) -> None:
    value = {"items": ("cube",), "scale": (0.95, 1.0), "density": (1e3, 2e3), "friction": (0.1, 0.2)}
    settings = _settings(Tables("random"))
    settings["tables.ranges"] = settings["tables.ranges"] | {field.name: value.get(field.name, 0.5)}
    one, other = _read(Tables("random")), conditions.read(settings)
    assert not one.same_tables(other)
    assert f"--{field.name.replace('_', '-')} " in conditions.notes({"a": one, "b": other})[1]


def test_what_was_seen_differs_on_the_same_tables() -> None:
    one, true = _read(Tables("hard")), _read(Tables("hard"), Camera(masks="true", height_noise=0.001), engine="mjx")
    assert one.same_tables(true)
    assert conditions.notes({"gn": one, "physics+gn": true})[1:] == [
        "Seen or simulated differently: --masks found (gn), true (physics+gn); --height-noise 0 (gn), 0.001 "
        "(physics+gn); --engine auto (gn), mjx (physics+gn)."
    ]


def test_what_was_not_recorded_is_said_to_be_so_and_makes_no_equal_tables() -> None:
    old = conditions.read({"tables.cases": "hard", "tables.objects": "10"})
    assert not old.same_tables(old) and conditions.notes({"gn": old}) == []
    assert "--seed 1000000 (gn), not recorded (old)" in conditions.notes({"gn": _read(Tables("hard")), "old": old})[0]


def test_names_of_tables_are_those_of_the_paper_only_for_its_tables() -> None:
    named = cleared.tables_name
    assert [named("hard", "10"), named("heldout", "10"), named("random", "30")] == ["hard", "heldout", "random-30"]
    assert named("random", "30", packed=True) == "packed-30"
    assert [named(f"my/{stem}.json", "10") for stem in ("hard", "heldout", "random-30", "packed-5", "a")] == [
        "own-hard", "own-heldout", "own-random-30", "own-packed-5", "a",
    ]  # fmt: skip


@pytest.mark.parametrize(("share", "name"), [(0.5, "random-10"), (1.0, "packed-10")])
def test_tables_that_are_all_packed_are_called_so(share: float, name: str, tmp_path: pathlib.Path) -> None:
    PARSERS["film"].prepare(tmp_path)
    made = _settings(Tables("random", ranges=Ranges(packed=share)), method="gn", label="")
    files.write_json(tmp_path / "settings.json", made)
    assert cleared.Cleared(tmp_path).tables == name


def test_damaged_settings_are_one_line(tmp_path: pathlib.Path) -> None:
    PARSERS["film"].prepare(tmp_path)
    metrics.write(tmp_path, metrics.read(tmp_path), settings=_settings(Tables("hard"), method="gn", label=""))
    assert cleared.Cleared(tmp_path).conditions == _read(Tables("hard"))
    settings = files.read_json(tmp_path / "settings.json")
    files.write_json(tmp_path / "settings.json", settings | {"seed": "x"})
    with pytest.raises(UserError, match=r"settings\.json: damaged, seed is x"):
        cleared.Cleared(tmp_path)


def test_random_tables_of_another_engine_lie_otherwise() -> None:
    assert not _read(Tables("random")).same_tables(_read(Tables("random"), engine="mjx"))
    assert _read(Tables("hard")).same_tables(_read(Tables("hard"), engine="mjx")), "the same cases"
