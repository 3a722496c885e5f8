"""Data sets joined to one, and shards that were copied by hand."""

import dataclasses
import json
import pathlib
import shutil
from typing import Any

import numpy as np
import pytest
from dipn_jax.datagen import cli
from dipn_jax.datagen.generate import Job, generate
from dipn_jax.train.push import PushTask

from dipn_jax.commands import console
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.storage import manifest, on_demand, records, shards
from dipn_jax.system import files
from dipn_jax.world import scenes

JOB = Job(
    kind="push", scene=scenes.fixed_count(3, spread=0.2), episodes=24, seed=0, shard_size=16, actions=4, engine="native"
)
"""What the fixture `data` has made of pushes."""
Data = dict[str, pathlib.Path]


def merge(*words: object) -> int:
    return console.run("dipn-datagen", cli.COMMANDS, ["merge", *map(str, words)])


def write(folder: pathlib.Path, parts: list[Any], config: dict[str, Any]) -> pathlib.Path:
    """Write a data set of pushes with these shards."""
    folder.mkdir()
    for index, episodes in enumerate(parts):
        shards.write_shard(folder, index, episodes, kind="push", config=config, faults={})
    manifest.update_manifest(folder)
    return folder


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return a data set of another seed, one shard."""
    out = tmp_path_factory.mktemp("other") / "push"
    generate(dataclasses.replace(JOB, seed=5, episodes=8, shard_size=8), out)
    return out


@pytest.fixture
def disks(data: Data, tmp_path: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """Return two folders in which two workers have made a shard each of one data set."""
    folders = (tmp_path / "disk1", tmp_path / "disk2")
    for index, folder in enumerate(folders):
        shutil.copytree(data["push"], folder)
        shards.shard_path(folder, 1 - index).unlink()
        manifest.update_manifest(folder)
        files.write_json(folder / "asked.json", {"command": ["push"], "of": 2})
    return folders


def test_shards_of_two_disks_are_the_data_set_of_one_worker(
    disks: tuple[pathlib.Path, pathlib.Path], data: Data, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "joined"
    assert merge(disks[1], disks[0], "--out", out) == 0
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and "missing" not in said.err, "the progress"
    assert "24 push episodes in 2 shards: 8 from" in said.out
    for name in ("config.json", "manifest.json", "shard-00000.parquet", "shard-00001.parquet"):
        assert (out / name).read_bytes() == (data["push"] / name).read_bytes(), name
    assert records.verify(out) == [] and records.missing(out) is None
    assert records.summary(out)["merged"] is None and (out / "asked.json").is_file()
    generate(dataclasses.replace(JOB, episodes=32), out)
    assert len(records.load(out, kind="push")[0].fault) == 32, "it can be extended"


def test_what_is_missing_of_one_data_set_is_said(
    disks: tuple[pathlib.Path, pathlib.Path], tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in disks:
        config = files.read_json(folder / "config.json")
        files.write_json(folder / "config.json", config | {"episodes": 48})
    assert merge(*disks, "--out", tmp_path / "j") == 0
    assert "24 of 48 episodes, shards 1, 2 missing: run `dipn-datagen push" in capsys.readouterr().err


def test_sets_made_apart_are_joined_and_their_difference_is_said(
    data: Data, other: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "joined"
    assert merge(data["push"], other, "--out", out) == 0
    said = capsys.readouterr().out
    assert f"{data['push']} and {other} differ: seed 0 and 5; shard_size 16 and 8" in said
    assert "32 push episodes in 3 shards: 24 from" in said
    assert records.verify(out) == [] and records.missing(out) is None
    episodes, _ = records.load(out, kind="push")
    parts = [records.load(folder, kind="push")[0] for folder in (data["push"], other)]
    np.testing.assert_array_equal(episodes.poses, np.concatenate([part.poses for part in parts]))
    about = records.summary(out)
    assert [(one["episodes"], one["config"]["seed"]) for one in about["merged"]] == [(24, 0), (8, 5)]
    assert console.run("dipn-datagen", cli.COMMANDS, ["verify", str(out)]) == 0
    assert PushTask(out, DipnConfig(), limit=None, centimetres=(5,)).size == 28
    assert merge(data["push"], other, "--out", out) == 0, "again"
    capsys.readouterr()
    words = ["push", "--episodes", "24", "--shard-size", "16", "--engine", "native", "--out", str(out)]
    assert console.run("dipn-datagen", cli.COMMANDS, words) == 2
    assert "a merged data set, which no command extends" in capsys.readouterr().err


def test_an_interrupted_merge_continues(
    data: Data, other: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, copied = shutil.copyfile, list[str]()

    def stop(source: pathlib.Path, target: pathlib.Path) -> None:
        copied.append(source.name)
        if len(copied) == 2:
            raise KeyboardInterrupt
        copy(source, target)

    monkeypatch.setattr(shutil, "copyfile", stop)
    assert merge(data["push"], other, "--out", tmp_path / "j") == 130
    assert not (tmp_path / "j" / "manifest.json").exists()
    assert merge(data["push"], other, "--out", tmp_path / "j") == 0
    assert len(copied) == 4 and len(records.load(tmp_path / "j", kind="push")[0].fault) == 32


def test_what_cannot_be_joined_is_one_line(
    data: Data,
    other: pathlib.Path,
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(says: str, *words: object) -> None:
        capsys.readouterr()
        assert merge(*words) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error, error

    out = ("--out", tmp_path / "j")
    push = data["push"]
    refused("0 folders with --out", *out)
    refused("2 folders without --out", push, other)
    refused("1 folders with --out", push, *out)
    refused("is named twice", push, push, *out)
    refused("is named twice", push, other, "--out", other)
    refused("want one kind", push, data["grasp"], *out)
    same = pathlib.Path(shutil.copytree(push, tmp_path / "same"))
    refused("are equal: the same scenes twice", push, same, *out)
    unsaid = [tmp_path / "unsaid1", tmp_path / "unsaid2"]  # without a seed, equal bytes alone tell
    path = shards.shard_path(push, 0)
    episodes, config = shards.read_shard(path, kind="push"), shards.read_meta(path)["config"]
    for number, folder in enumerate(unsaid):
        write(folder, [episodes[number:], episodes[:5]], {})
    refused("shard-00001.parquet are equal: the same scenes twice", *unsaid, *out)
    slower = write(tmp_path / "slower", [episodes[:4]], config | {"actions": 2})
    refused("are both made of seed 0 with number 0: the same scenes twice", push, slower, *out)
    wider = write(tmp_path / "wider", [on_demand.widened(episodes, 4)], {"seed": 9})
    files.write_json(wider / "config.json", JOB.describe())
    refused("has number of object slots 3", push, wider, *out)
    with monkeypatch.context() as patch:
        patch.setattr(shards, "MOST_SHARDS", 2)
        refused("3 shards, more than their names can number (2)", push, other, *out)
    assert not (tmp_path / "j").exists()
    refused("holds another data set", push, other, "--out", wider)
    (wider / "config.json").unlink()
    shutil.copy(shards.shard_path(wider, 0), shards.shard_path(wider, 7))
    refused("holds another data set", push, other, "--out", wider)


def test_shards_that_were_copied_by_hand_are_listed(
    disks: tuple[pathlib.Path, pathlib.Path], other: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = disks
    shutil.copy(shards.shard_path(second, 1), first)
    assert list(manifest.listed(first)) == ["shard-00000.parquet"]
    assert console.run("dipn-datagen", cli.COMMANDS, ["verify", str(first)]) == 0
    assert merge(first) == 0
    assert f"{first}: 24 push episodes in 2 shards" in capsys.readouterr().out
    assert list(manifest.listed(first)) == ["shard-00000.parquet", "shard-00001.parquet"]
    shutil.copy(shards.shard_path(other, 0), shards.shard_path(first, 2))
    assert merge(first) == 2
    assert "differ in seed 0 and 5; copy only shards of one data set together" in capsys.readouterr().err
    assert json.loads((first / "manifest.json").read_text())["episodes"] == 24
    shutil.copy(shards.shard_path(first, 0), shards.shard_path(first, 2))
    assert merge(first) == 2
    assert "are equal" in capsys.readouterr().err
    shards.shard_path(first, 2).write_bytes(b"no shard")
    assert merge(first) == 2
    assert "shard-00002.parquet" in capsys.readouterr().err
