import dataclasses
import errno
import fcntl
import json
import pathlib
import shutil
from typing import Any

import numpy as np
import pytest
from dipn_jax.datagen.generate import Job, generate

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.physics import native
from dipn_jax.storage import manifest, records, shards
from dipn_jax.world import scenes

JOB = Job(
    kind="push",
    scene=scenes.fixed_count(3, spread=0.2),
    episodes=24,
    seed=0,
    shard_size=16,
    actions=4,
    engine="native",
    timestep=None,
)


@pytest.fixture
def copy(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> pathlib.Path:
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))


def test_push_episodes_are_pushes(data: dict[str, pathlib.Path]) -> None:
    episodes, _ = records.load(data["push"], kind="push")
    assert len(episodes.fault) == 24 and episodes.poses.shape == (24, 11, 3, 7)
    shift = np.linalg.norm(episodes.poses[:, 10, :, :2] - episodes.poses[:, 0, :, :2], axis=-1)
    assert (shift.max(-1) > 0.02).mean() > 0.8, "most pushes move something"
    still = np.linalg.norm(episodes.poses[:, 1, :, :2] - episodes.poses[:, 0, :, :2], axis=-1)
    assert still.max() < 0.01, "the first centimetre is free"


def test_grasp_episodes_agree_with_their_outcome(data: dict[str, pathlib.Path]) -> None:
    episodes, _ = records.load(data["grasp"], kind="grasp")
    np.testing.assert_array_equal(episodes.success, episodes.held.any(-1))
    rise = episodes.after[..., 2] - episodes.poses[..., 2]
    assert (rise[episodes.held] > 0.075).all()
    assert 0 < episodes.success.mean() < 1


def test_a_shard_is_the_same_by_another_worker(copy: pathlib.Path, tmp_path: pathlib.Path) -> None:
    other = tmp_path / "other"
    generate(JOB, other, part=1, of=2)
    assert sorted(p.name for p in other.glob("*.parquet")) == ["shard-00001.parquet"]
    assert shards.shard_path(other, 1).read_bytes() == shards.shard_path(copy, 1).read_bytes()


@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_makes_the_same_bytes(
    threads: int, copy: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[int] = []
    made = native.NativeEngine.__init__

    def spied(self: native.NativeEngine, *args: Any, **named: Any) -> None:
        made(self, *args, **named)
        used.append(self.threads)

    monkeypatch.setattr(native.NativeEngine, "__init__", spied)
    generate(JOB, tmp_path / "own", threads=threads)
    assert used == [threads]
    for name in ("config.json", "manifest.json", *(f"shard-{i:05d}.parquet" for i in range(2))):
        assert (tmp_path / "own" / name).read_bytes() == (copy / name).read_bytes(), name


def test_a_gap_is_filled_with_the_same_bytes_and_the_rest_left_alone(copy: pathlib.Path) -> None:
    first, second = shards.shard_path(copy, 0), shards.shard_path(copy, 1)
    wanted, untouched = second.read_bytes(), first.stat().st_mtime_ns
    second.unlink()
    generate(JOB, copy)
    assert second.read_bytes() == wanted
    assert first.stat().st_mtime_ns == untouched
    assert records.verify(copy) == []


def test_an_interruption_loses_at_most_the_unfinished_shards(
    copy: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "new"
    original = shards.write_shard
    job = dataclasses.replace(JOB, episodes=33)

    def die_at_third(folder: pathlib.Path, index: int, *args: Any, **options: Any) -> dict[str, Any]:
        if index == 2:
            raise KeyboardInterrupt
        return original(folder, index, *args, **options)

    monkeypatch.setattr(shards, "write_shard", die_at_third)
    with pytest.raises(KeyboardInterrupt):
        generate(job, out)
    monkeypatch.undo()
    assert records.verify(out) == [] and list(out.glob("*.parquet"))
    generate(job, out)
    assert records.verify(out) == [] and len(records.load(out, kind="push")[0].fault) == 33
    for index in (0,):  # the second is longer here
        assert shards.shard_path(out, index).read_bytes() == shards.shard_path(copy, index).read_bytes()


def test_the_manifest_is_written_once_however_many_shards_there_are(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    write = manifest.write
    monkeypatch.setattr(manifest, "write", lambda at, entries: written.append(len(entries)) or write(at, entries))
    job = dataclasses.replace(JOB, kind="images", episodes=4, shard_size=1, actions=1)
    generate(job, tmp_path / "alone")
    assert written == [4]
    for part in (2, 0, 1):
        assert not (tmp_path / "array" / manifest.MANIFEST).exists()
        generate(job, tmp_path / "array", part=part, of=3)
    assert written == [4, 4], "the last of several workers has written it"
    assert (tmp_path / "array" / manifest.MANIFEST).read_bytes() == (
        tmp_path / "alone" / manifest.MANIFEST
    ).read_bytes()


def test_a_worker_without_a_shard_says_so(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = dataclasses.replace(JOB, kind="images", episodes=2, shard_size=1, actions=1)
    generate(job, tmp_path, part=2, of=4)
    said = capsys.readouterr()
    assert "warning: --shard 2 --of 4: no shard is left for this worker: there are 2; want --of 2 at most\n" in said.err
    assert "0 of 2 shards are there" in said.out
    generate(job, tmp_path, part=1, of=2)
    said = capsys.readouterr()
    assert "warning" not in said.err and "1 of 2 shards are there" in said.out


def test_a_data_set_whose_extension_is_killed_stays_whole(copy: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last shard is made longer; killed before or after that, the manifest does not contradict it."""
    write, update = shards.write_shard, manifest.update_manifest

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(manifest, "update_manifest", stopped)  # killed: no time is left for it
    monkeypatch.setattr(shards, "write_shard", stopped)
    for writing, episodes in ((stopped, 24), (write, 28)):
        monkeypatch.setattr(shards, "write_shard", writing)
        with pytest.raises(KeyboardInterrupt):
            generate(dataclasses.replace(JOB, episodes=28), copy)
        assert records.verify(copy) == [] and len(records.load(copy, kind="push")[0].fault) == episodes
    monkeypatch.setattr(manifest, "update_manifest", update)
    generate(dataclasses.replace(JOB, episodes=28), copy)
    assert records.verify(copy) == [] and records.missing(copy) is None


def test_another_config_in_the_same_folder_is_refused(copy: pathlib.Path) -> None:
    before = sorted((p.name, p.read_bytes()) for p in copy.iterdir())
    with pytest.raises(UserError, match="seed=0, asked for seed=1"):
        generate(dataclasses.replace(JOB, seed=1), copy)
    assert sorted((p.name, p.read_bytes()) for p in copy.iterdir()) == before


def test_what_determines_a_data_set_is_stored_under_the_names_that_data_sets_in_use_have() -> None:
    assert set(JOB.describe()) == {
        "kind", "scene", "episodes", "seed", "shard_size", "actions", "engine", "timestep", "distances", "guided",
        "hard", "weights",
    }  # fmt: skip


def test_a_data_set_can_grow(copy: pathlib.Path) -> None:
    generate(dataclasses.replace(JOB, episodes=32), copy)
    assert len(records.load(copy, kind="push")[0].fault) == 32
    assert json.loads((copy / "config.json").read_text())["episodes"] == 32
    with pytest.raises(UserError, match="begun with 32 episodes, asked for 24"):
        generate(JOB, copy)
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"episodes": None}))
    with pytest.raises(UserError, match="episodes is null, want a whole number"):
        generate(JOB, copy)


def test_a_shard_does_not_depend_on_the_number_of_shards(copy: pathlib.Path, tmp_path: pathlib.Path) -> None:
    generate(dataclasses.replace(JOB, episodes=16), tmp_path / "short")
    assert shards.shard_path(tmp_path / "short", 0).read_bytes() == shards.shard_path(copy, 0).read_bytes()


def test_every_distance_gets_its_own_push_from_the_same_scene(tmp_path: pathlib.Path) -> None:
    generate(dataclasses.replace(JOB, episodes=12, shard_size=12, distances=(0.03, 0.1)), tmp_path / "sweep")
    episodes, _ = records.load(tmp_path / "sweep", kind="push")
    short, long = (structs.take(episodes, slice(i, None, 2)) for i in (0, 1))
    np.testing.assert_allclose(short.push.distance, 0.03, atol=1e-6)
    np.testing.assert_allclose(long.push.distance, 0.1, atol=1e-6)
    np.testing.assert_allclose(short.poses[:, :3], long.poses[:, :3], atol=1e-6)
    shift = [np.linalg.norm(part.after[..., :2] - part.poses[:, 0, :, :2], axis=-1).max(-1) for part in (short, long)]
    assert (shift[0] < shift[1])[shift[1] > 0.04].all() and (shift[1] > 0.04).any()


def test_invalid_options_are_refused(tmp_path: pathlib.Path) -> None:
    for change in ({"episodes": -1}, {"shard_size": 0}, {"actions": 0}):
        with pytest.raises(UserError, match=r"want a number above 0|want 1 to 256"):
            dataclasses.replace(JOB, **change)
    for distances in ((), (0.2,), (0.05, float("nan"))):
        with pytest.raises(UserError, match="--distances"):
            dataclasses.replace(JOB, distances=distances)
    with pytest.raises(UserError, match=r"--distances 0.05 0.05: want"):
        dataclasses.replace(JOB, distances=(0.05, 0.05))
    for timestep in (-0.002, 0.004, 0.0, 1e-9, 1e-320, float("nan")):
        with pytest.raises(UserError, match=f"--timestep {timestep}: want"):
            generate(dataclasses.replace(JOB, timestep=timestep), tmp_path / "x")
    with pytest.raises(UserError, match="100001 shards, more than"):
        dataclasses.replace(JOB, episodes=100_001, shard_size=1)
    with pytest.raises(UserError, match="--seed"):
        generate(dataclasses.replace(JOB, seed=-1), tmp_path / "x")
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="is not a folder"):
        generate(JOB, tmp_path / "file")
    with pytest.raises(UserError, match="--shard 2 --of 2"):
        generate(JOB, tmp_path / "x", part=2, of=2)
    assert not (tmp_path / "x").exists()


def test_without_locks_a_data_set_is_made_all_the_same_with_one_line(
    copy: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """NFS and Lustre may refuse locks; both shards of this data set are made side by side."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    out = tmp_path / "new"
    generate(JOB, out)
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "warning" in line] == [
        f"warning: {out}: its file system has no locks; workers list their shards without taking turns"
    ]
    assert records.verify(out) == []
    for path in copy.glob("*.parquet"):
        assert (out / path.name).read_bytes() == path.read_bytes()
