"""What a data set holds is compared with what was asked for, and who made it is listed."""

import functools
import json
import pathlib
import shutil
from typing import Any

import pyarrow.parquet
import pytest
from dipn_jax.datagen import cli, upkeep

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, records, shards
from dipn_jax.storage.manifest import MANIFEST, update_manifest
from dipn_jax.system import files, machine

COMMAND = ("push", "--episodes", "24", "--shard-size", "16")


@pytest.fixture
def copy(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> pathlib.Path:
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))


def _without(folder: pathlib.Path, index: int) -> None:
    """Let a data set be as if the worker of a shard had never run."""
    shards.shard_path(folder, index).unlink()
    update_manifest(folder)


def test_a_whole_data_set_misses_nothing(copy: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert records.missing(copy) is None and records.summary(copy)["missing"] is None
    assert records.summary(copy)["asked"] == 24
    upkeep.verify(copy)
    records.load(copy, kind="push")
    assert capsys.readouterr().err == ""


def test_a_worker_that_never_ran_is_named_with_its_command(
    copy: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    accounting.save_command(copy, COMMAND, of=2)
    _without(copy, 1)
    command = f"dipn-datagen push --episodes 24 --shard-size 16 --out {copy} --shard 1 --of 2"
    said = f"{copy}: 16 of 24 episodes, shard 1 missing: run `{command}`"
    assert records.missing(copy) == said and records.verify(copy) == []
    with pytest.raises(UserError) as refused:
        upkeep.verify(copy)
    assert str(refused.value) == said
    upkeep.info(copy)
    shown = capsys.readouterr()
    assert json.loads(shown.out)["missing"] == said and shown.err == f"warning: {said}\n"
    assert len(records.load(copy, kind="push")[0].fault) == 16, "training continues"
    assert capsys.readouterr().err == f"warning: {said}\n"


@pytest.mark.parametrize(
    ("held", "said"),
    [
        ({0: 3, 1: 3, 2: 2}, None),
        ({0: 3, 2: 2}, "5 of 8 episodes, shard 1 missing: run `dipn-datagen push --out {} --shard 1 --of 3`"),
        ({0: 3, 1: 3, 2: 1}, "7 of 8 episodes, shard 2 missing: run `dipn-datagen push --out {} --shard 2 --of 3`"),
        ({2: 2}, "2 of 8 episodes, shards 0, 1 missing: run `dipn-datagen push --out {}`"),
        ({0: 3, 1: 3, 7: 3}, "6 of 8 episodes, shard 2 missing: run `dipn-datagen push --out {} --shard 2 --of 3`"),
    ],
)
def test_what_is_missing_is_said_with_what_fills_it(
    tmp_path: pathlib.Path, held: dict[int, int], said: str | None
) -> None:
    files.write_json(tmp_path / "config.json", {"episodes": 8, "shard_size": 3})
    accounting.save_command(tmp_path, ["push"], of=3)
    found = accounting.missing(tmp_path, held)
    assert found == (None if said is None else f"{tmp_path}: {said.format(tmp_path)}")


def test_of_many_missing_shards_some_are_named(tmp_path: pathlib.Path) -> None:
    files.write_json(tmp_path / "config.json", {"episodes": 10**15, "shard_size": 1})
    accounting.save_command(tmp_path, ["push"], of=2)
    said = accounting.missing(tmp_path, {1: 1})
    assert said is not None and "1 of 1000000000000000 episodes, shards 0, 2, 3, 4, 5, 6, 7, 8 and 9999" in said
    assert said.endswith(f"run `dipn-datagen push --out {tmp_path}`")


def test_where_not_all_missing_shards_are_looked_at_the_command_makes_everything(tmp_path: pathlib.Path) -> None:
    files.write_json(tmp_path / "config.json", {"episodes": 40, "shard_size": 1})
    accounting.save_command(tmp_path, ["push"], of=2)
    said = str(accounting.missing(tmp_path, dict.fromkeys(range(1, 19, 2), 1)))  # the first gaps are of one worker
    assert "shards 0, 2, 4, 6, 8, 10, 12, 14 and 23 more missing" in said and "--of" not in said


def test_a_command_is_shown_on_one_line_and_as_a_shell_reads_it(tmp_path: pathlib.Path) -> None:
    files.write_json(tmp_path / "config.json", {"episodes": 8, "shard_size": 8})
    accounting.save_command(tmp_path, ["grasp", "--grasp-net", "my runs/gn; x", "a\nb"], of=1)
    said = str(accounting.missing(tmp_path, {}))
    assert f"run `dipn-datagen grasp --grasp-net 'my runs/gn; x' 'a?b' --out {tmp_path}`" in said and "\n" not in said


def test_where_nothing_was_asked_for_nothing_is_missing(copy: pathlib.Path) -> None:
    _without(copy, 1)
    assert str(records.missing(copy)).endswith("missing: run the command that made it again"), "none was kept"
    (copy / "config.json").unlink()
    assert records.missing(copy) is None and records.summary(copy)["asked"] is None


def test_a_damaged_configuration_is_one_line_and_training_goes_on(
    copy: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "config.json").write_text('{"episodes": "many"}')
    with pytest.raises(UserError, match=r"config\.json: damaged, episodes is many, want a whole number"):
        upkeep.verify(copy)
    assert len(records.load(copy, kind="push")[0].fault) == 24
    assert "episodes is many" in capsys.readouterr().err


def _given(arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Return the words that are kept of a command."""
    kept: list[tuple[str, ...]] = []
    monkeypatch.setattr("dipn_jax.datagen.generate.generate", lambda *_, command, **__: kept.append(tuple(command)))
    assert console.run("test", cli.COMMANDS, arguments) == 0
    return kept[0]


@pytest.mark.parametrize(
    ("line", "kept"),
    [
        ("push --out x", "push"),
        ("push --out x --episodes 4 --shard-size 2 --shard 0 --of 2 --threads 1", "push --episodes 4 --shard-size 2"),
        ("push --out=x --distances 0.03 0.1 --timestep 0.001", "push --distances 0.03 0.1 --timestep 0.001"),
        ("grasp --out x --objects 1:7 --items triangle concave --scale 0.9 1", None),
        ("images --out x --engine native --seed 3 --color-noise 0.1", None),
        ("grasp --out x --grasp-net builtin --unsure 0.5", "grasp --grasp-net builtin --unsure 0.5"),
    ],
)
def test_the_command_that_is_kept_asks_for_the_same(
    line: str, kept: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = _given(tuple(line.split()), monkeypatch)
    assert kept is None or found == tuple(kept.split())
    assert _given((*found, "--out", "y"), monkeypatch) == found


def test_generation_keeps_its_command(tmp_path: pathlib.Path) -> None:
    words = ["images", "--episodes", "2", "--objects", "2", "--shard-size", "1", "--engine", "native"]
    assert console.run("test", cli.COMMANDS, [*words, "--out", str(tmp_path), "--shard", "1", "--of", "2"]) == 0
    said = str(records.missing(tmp_path))
    assert said.startswith(f"{tmp_path}: 1 of 2 episodes, shard 0 missing: run `dipn-datagen images ")
    assert console.run("test", cli.COMMANDS, said.split("`")[1].split()[1:]) == 0
    assert records.missing(tmp_path) is None


def test_everybody_who_made_shards_is_listed_and_a_mix_is_said(
    copy: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (alone,) = records.summary(copy)["made_by"]
    assert (alone["processor"], alone["instructions"]) == (machine.processor(), machine.instructions())
    assert alone["shards"] == 2 and alone["versions"] == files.package_versions()
    assert accounting.describe_mixed_makers([alone]) is None
    monkeypatch.setattr(machine, "processor", lambda: "Abacus")
    monkeypatch.setattr(files, "package_versions", lambda: alone["versions"] | {"mujoco": "9.9"})
    episodes = shards.read_shard(shards.shard_path(copy, 1), kind="push")
    shards.write_shard(copy, 1, episodes, kind="push", config={}, faults={})
    update_manifest(copy)
    made_by: list[dict[str, Any]] = records.summary(copy)["made_by"]
    assert [one["shards"] for one in made_by] == [1, 1]
    for look in (upkeep.info, upkeep.verify, functools.partial(records.load, kind="push")):
        look(copy)
        line = capsys.readouterr().err
        assert line.count("\n") == 1 and "different versions or kinds of processor" in line
        for fact in ("Abacus (", f"{alone['processor']} (", f"mujoco {alone['versions']['mujoco']} and mujoco 9.9"):
            assert fact in line
        assert "numpy" not in line, "which is the same"


def test_a_shard_that_does_not_say_who_made_it_is_read(copy: pathlib.Path) -> None:
    """As those that were made before shards said so."""
    for index in range(2):
        path = shards.shard_path(copy, index)
        table = pyarrow.parquet.read_table(path)
        meta = json.loads(table.schema.metadata[b"dipn_jax"])
        del meta["processor"], meta["instructions"]
        pyarrow.parquet.write_table(table.replace_schema_metadata({"dipn_jax": json.dumps(meta)}), path)
    (copy / MANIFEST).unlink()
    update_manifest(copy)
    (one,) = records.summary(copy)["made_by"]
    assert (one["processor"], one["instructions"], one["shards"]) == ("not recorded", "not recorded", 2)
    assert len(records.load(copy, kind="push")[0].fault) == 24
