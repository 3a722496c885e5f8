"""Episodes are simulated again from what is stored, exactly; what was altered, or made otherwise, is found."""

import json
import pathlib
import shutil
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dipn_jax.datagen import cli, replay

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.storage import codec, records, shards
from dipn_jax.storage.manifest import MANIFEST, update_manifest
from dipn_jax.system import machine


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str]):
    def run(*arguments: object) -> tuple[int, list[str], str]:
        code = console.run("test", cli.COMMANDS, ["replay", *map(str, arguments)])
        said = capfd.readouterr()
        return code, said.out.splitlines(), said.err

    return run


def rewritten(folder: pathlib.Path, out: pathlib.Path, change: Any) -> pathlib.Path:
    """Copy a data set of one kind; its first shard has the episodes that `change` makes of its own."""
    copy = pathlib.Path(shutil.copytree(folder, out))
    path = shards.shard_path(copy, 0)
    meta = shards.read_meta(path)
    episodes = change(shards.read_shard(path, kind=meta["kind"]))
    shards.write_shard(copy, 0, episodes, kind=meta["kind"], config=meta["config"], faults=meta["faults"])
    (copy / MANIFEST).unlink()
    update_manifest(copy)
    return copy


@pytest.mark.parametrize("kind", ["push", "grasp"])
def test_a_data_set_is_replayed_exactly(kind: str, data: dict[str, pathlib.Path], call) -> None:
    code, lines, _ = call(data[kind], "--all", "--threads", "1")
    assert code == 0 and len(lines) == 25
    assert "all 24 are as stored, within 1e-06" in lines[-1]
    assert ("held as stored" in lines[0]) == (kind == "grasp")


def test_sets_that_were_simulated_differently_are_not_replayed_as_one(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, call
) -> None:
    copy = pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))
    path = shards.shard_path(copy, 1)
    config = shards.read_meta(path)["config"] | {"timestep": 0.001}
    shards.write_shard(copy, 1, shards.read_shard(path, kind="push"), kind="push", config=config, faults={})
    (copy / MANIFEST).unlink()
    update_manifest(copy)
    code, _, error = call(copy, "--all")
    assert code == 2 and error.count("\n") == 1
    assert "simulated differently (native at 0.001 s, native at its own step)" in error


def test_what_is_replayed_is_what_is_stored_to_the_last_bit(data: dict[str, pathlib.Path], engine: Any) -> None:
    """One by one, in another batch than they were made in."""
    for kind in ("push", "grasp"):
        episodes, _ = records.load(data[kind], kind=kind)
        for number in (0, 17):
            again = replay.replayed(structs.take(episodes, slice(number, number + 1)), engine)
            stored, _ = codec.encode(codec.columns(structs.take(episodes, slice(number, number + 1))))
            for name, column in codec.encode(codec.columns(again))[0].items():
                np.testing.assert_array_equal(column, stored[name], err_msg=name)


def test_a_record_that_was_altered_is_found(data: dict[str, pathlib.Path], tmp_path: pathlib.Path, call) -> None:
    def moved(episodes: Any) -> Any:
        after = np.array(episodes.after)
        after[5, 1, 0] += 5e-6
        return episodes.replace(after=after)

    copy = rewritten(data["push"], tmp_path / "push", moved)
    code, lines, _ = call(copy, 4, "5:7")
    assert code == 1 and lines[1].startswith("5: 0.005") and "1 of 3 differ by more than 1e-06" in lines[-1]
    assert call(copy, 5, "--tolerance", "1e-5")[0] == 0

    def turned(episodes: Any) -> Any:
        angle = np.array(episodes.push.angle)
        angle[2] += 0.3
        return episodes.replace(push=episodes.push.replace(angle=angle))

    code, lines, _ = call(rewritten(data["push"], tmp_path / "turned", turned), "1:4")
    assert code == 1 and "1 of 3 differ" in lines[-1] and float(lines[1].split()[1]) > 1


def test_flags_that_were_altered_are_found(data: dict[str, pathlib.Path], tmp_path: pathlib.Path, call) -> None:
    def changed(episodes: Any) -> Any:
        held, fault = np.array(episodes.held), np.array(episodes.fault)
        held[3, 1] ^= True
        fault[4] ^= structs.Fault.OUTSIDE
        return episodes.replace(held=held, fault=fault)

    code, lines, _ = call(rewritten(data["grasp"], tmp_path / "grasp", changed), "3:6", "--tolerance", 1)
    assert code == 1 and "2 of 3 differ" in lines[-1]
    assert "; held " in lines[0] and "held as stored; faults " in lines[1] and lines[2].endswith("held as stored")


def test_objects_that_are_not_there_do_not_count(data: dict[str, pathlib.Path]) -> None:
    (one,) = records.load(data["push"], kind="push")[:1]
    stored = one[0].replace(scene=one[0].scene.replace(shape=np.array([0, -1, 0])))
    after = np.array(stored.after)
    after[1] += 1
    assert replay.difference(stored, stored.replace(after=after)).component == 0
    after[2, 3:] *= -1  # the same turn
    assert not replay.difference(stored, stored.replace(after=after)).beyond(1e-6)
    after[0, 2] = np.nan
    assert replay.difference(stored, stored.replace(after=after)).beyond(1e-6)


def test_another_time_step_is_another_simulation(data: dict[str, pathlib.Path], call) -> None:
    code, lines, _ = call(data["push"], "0:4", "--engine", "native", "--timestep", 0.005)
    assert code == 1 and "differ by more than" in lines[-1]


def test_shards_from_before_replay_are_named(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, call
) -> None:
    monkeypatch.setattr(shards, "ROUNDED_START", "")
    old = rewritten(data["push"], tmp_path / "old", lambda episodes: episodes)
    monkeypatch.undo()
    error = call(old, 0)[2]
    assert "warning: " in error and "1 shards are older than exact replay" in error
    assert "warning" not in call(data["push"], 0)[2]
    meta = json.loads(pq.read_schema(shards.shard_path(data["push"], 0)).metadata[b"dipn_jax"])
    assert meta["start"] == "rounded"


def test_another_instruction_set_is_named(data: dict[str, pathlib.Path], monkeypatch: pytest.MonkeyPatch, call) -> None:
    here = machine.instructions()
    monkeypatch.setattr(machine, "instructions", lambda: "sparc")
    assert f"made with {here}, replayed with sparc" in call(data["push"], 0)[2]


def test_a_sample_is_drawn_without_repeats(data: dict[str, pathlib.Path], call) -> None:
    numbers = [line.partition(":")[0] for line in call(data["push"], "--sample", 6)[1][:-1]]
    assert len(set(numbers)) == 6 and numbers != [str(i) for i in range(6)]
    assert len(call(data["push"], "--sample", 100)[1]) == 25


def test_mistakes_are_one_line(data: dict[str, pathlib.Path], tmp_path: pathlib.Path, call) -> None:
    for words, says in (
        ((data["push"], 24), "no such episode in"),
        ((data["push"], "20:25"), "which has 0 to 23"),
        ((data["push"], "8:5"), "no such episode"),
        ((data["push"], "five"), "want the number of an episode"),
        ((data["push"], "1:2:3"), "want the number of an episode"),
        ((data["push"],), "give numbers of episodes, or --all"),
        ((data["push"], 3, "--all"), "give numbers of episodes, or --all"),
        ((data["push"], "--sample", 0), "--sample 0"),
        ((data["push"], 0, "--tolerance", "nan"), "--tolerance nan"),
        ((data["push"], 0, "--threads", 0), "--threads 0"),
        ((data["images"], 0), "nothing to simulate"),
        ((tmp_path, 0), "no manifest.json"),
    ):
        code, _, error = call(*words)
        assert code == 2 and says in error and error.count("\n") == 1, (words, error)
