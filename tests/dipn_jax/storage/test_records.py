import errno
import fcntl
import json
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.storage import codec, records, shards
from dipn_jax.storage.manifest import MANIFEST, update_manifest
from dipn_jax.system import files


@pytest.fixture
def copy(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> pathlib.Path:
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))


def test_episodes_are_read_as_they_were_written(copy: pathlib.Path, tmp_path: pathlib.Path) -> None:
    episodes = shards.read_shard(shards.shard_path(copy, 0), kind="push")
    shards.write_shard(tmp_path, 3, episodes, kind="push", config={"seed": 0}, faults={})
    again = shards.read_shard(shards.shard_path(tmp_path, 3), kind="push")
    for name in ("poses", "after", "fault"):
        np.testing.assert_array_equal(getattr(again, name), getattr(episodes, name))
    np.testing.assert_array_equal(again.scene.size, episodes.scene.size)
    np.testing.assert_array_equal(again.push.start, episodes.push.start)


def test_a_data_set_records_how_it_was_made(copy: pathlib.Path) -> None:
    summary = records.summary(copy)
    assert summary["episodes"] == 24 and summary["shards"] == 2 and summary["kind"] == "push"
    assert summary["config"]["seed"] == 0 and summary["config"]["engine"] == "native"
    assert summary["versions"]["mujoco"] != "unknown"
    assert summary["faults"]["dropped_scenes"] > 0


def test_any_tool_opens_a_shard(copy: pathlib.Path) -> None:
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(shards.shard_path(copy, 0))
    assert "scene.shape" in table.column_names and "push.angle" in table.column_names


@pytest.mark.parametrize("damage", ["truncate", "empty", "flip", "delete", "foreign"])
def test_a_damaged_shard_is_named_and_repaired(copy: pathlib.Path, damage: str) -> None:
    path = shards.shard_path(copy, 1)
    content = path.read_bytes()
    if damage == "truncate":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "flip":
        path.write_bytes(content[:200] + bytes([content[200] ^ 1]) + content[201:])
    elif damage == "delete":
        path.unlink()
    else:
        path.write_bytes(b"not a parquet file, but as long" * 100)
    assert [p.name for p, _ in records.verify(copy)] == [path.name]
    with pytest.raises(UserError, match=r"shard-00001\.parquet"):
        records.load(copy, kind="push")
    set_aside = records.repair(copy)
    assert len(set_aside) == (damage != "delete")
    assert records.verify(copy) == []
    assert len(records.load(copy, kind="push")[0].fault) == 16


def test_the_wrong_kind_a_missing_and_an_old_data_set_are_named(copy: pathlib.Path, tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match="holds push episodes, want grasp"):
        records.load(copy, kind="grasp")
    with pytest.raises(UserError, match="no manifest"):
        records.load(tmp_path / "nowhere", kind="push")
    (copy / MANIFEST).write_text("{")
    with pytest.raises(UserError, match="damaged"):
        records.load(copy, kind="push")


def test_another_schema_version_is_named(copy: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "READABLE", (2, 99))
    with pytest.raises(UserError, match="schema version 3, want 2 or 99"):
        shards.read_shard(shards.shard_path(copy, 0), kind="push")
    with pytest.raises(UserError, match="schema version 3, want 2 or 99"):
        records.repair(copy)
    assert shards.shard_path(copy, 0).exists(), "what is only old is not set aside"


def test_a_shard_of_version_2_is_read_and_stands_beside_new_ones(copy: pathlib.Path) -> None:
    """Kept: five pushes of seven slots, their poses as differences in time, and the numbers that they stand for."""
    kept = pathlib.Path(__file__).parent / "kept"
    folder = copy.parent / "old"
    folder.mkdir()
    shutil.copy(kept / "push-v2.parquet", shards.shard_path(folder, 0))
    meta = shards.read_meta(shards.shard_path(folder, 0))
    assert meta["schema_version"] == 2 and meta["columns"]["poses"]["code"] == "delta"
    old = shards.read_shard(shards.shard_path(folder, 0), kind="push")
    with np.load(kept / "push-v2.npz", allow_pickle=False) as wanted:
        for name, value in codec.columns(old).items():
            np.testing.assert_array_equal(value, wanted[name], err_msg=name)
    shards.write_shard(folder, 1, old, kind="push", config={}, faults={})
    meta = shards.read_meta(shards.shard_path(folder, 1))
    assert meta["schema_version"] == 3 and meta["columns"]["poses"]["code"] == "value"
    update_manifest(folder)
    assert records.verify(folder) == []
    both, _ = records.load(folder, kind="push")
    np.testing.assert_array_equal(both.poses[:5], both.poses[5:])
    np.testing.assert_array_equal(both.after[:5], both.after[5:])


def test_a_folder_that_is_no_data_set_is_left_alone(tmp_path: pathlib.Path) -> None:
    (tmp_path / "shard-1.parquet").write_text("somebody else's")
    with pytest.raises(UserError, match="no such data set"):
        records.repair(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["shard-1.parquet"]


def test_the_fingerprint_follows_the_content(copy: pathlib.Path) -> None:
    before = records.load(copy, kind="push")[1]
    assert records.load(copy, kind="push")[1] == before
    shards.shard_path(copy, 1).unlink()
    update_manifest(copy)
    assert records.load(copy, kind="push")[1] != before


def test_a_write_that_is_interrupted_leaves_the_old_file(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "manifest.json"
    files.write_json(path, {"a": 1})

    def die(self: pathlib.Path, target: pathlib.Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pathlib.Path, "rename", die)
    with pytest.raises(KeyboardInterrupt):
        files.write_json(path, {"a": 2})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["manifest.json"]


@pytest.mark.parametrize("gone", ["bytes", "sha256", "episodes", "faults"])
def test_a_manifest_without_some_of_its_keys_is_damaged(copy: pathlib.Path, gone: str) -> None:
    manifest = json.loads((copy / "manifest.json").read_text())
    for entry in manifest["shards"].values():
        del entry[gone]
    (copy / "manifest.json").write_text(json.dumps(manifest))
    for look in (records.verify, records.summary):
        with pytest.raises(UserError, match=r"manifest\.json is damaged; run dipn-datagen repair"):
            look(copy)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("bytes", "9"),
        ("sha256", 1),
        ("episodes", 0),
        ("episodes", 1.5),
        ("faults", [1]),
        ("faults", {"a": "b"}),
        ("kind", 3),
    ],
)
def test_a_manifest_with_entries_of_other_types_is_damaged(copy: pathlib.Path, key: str, value: object) -> None:
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["shards"]["shard-00001.parquet"][key] = value
    (copy / "manifest.json").write_text(json.dumps(manifest))
    for look in (records.verify, records.summary, update_manifest):
        with pytest.raises(UserError, match=r"manifest\.json is damaged; run dipn-datagen repair") as caught:
            look(copy)
        assert "\n" not in str(caught.value)
    assert records.repair(copy) == [] and records.verify(copy) == []


def test_a_manifest_that_counts_other_episodes_is_wrong(copy: pathlib.Path) -> None:
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["shards"]["shard-00001.parquet"]["episodes"] = 7
    (copy / "manifest.json").write_text(json.dumps(manifest))
    ((path, what),) = records.verify(copy)
    assert path.name == "shard-00001.parquet" and what == "8 push episodes, want 7 push"
    assert records.repair(copy) == [] and records.verify(copy) == []


def test_where_files_cannot_be_locked_the_manifest_is_written_all_the_same(tmp_path: pathlib.Path) -> None:
    script = (
        "import pathlib, sys; sys.modules['fcntl'] = None\n"  # as where there is no such module
        "from dipn_jax.storage import manifest\n"
        "assert manifest.update_manifest(pathlib.Path(sys.argv[1]))['episodes'] == 0"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=True)
    assert (tmp_path / MANIFEST).is_file()


def _no_locks(*_: object) -> None:
    raise OSError(errno.ENOLCK, "No locks available")


def test_without_locks_a_shard_that_comes_while_the_manifest_is_written_is_listed(
    copy: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fcntl, "flock", _no_locks)
    late = shards.shard_path(copy, 1)
    content, write = late.read_bytes(), files.write_json
    late.unlink()

    def slow(path: pathlib.Path, value: object) -> None:
        late.write_bytes(content)  # by another worker, who is quicker
        write(path, value)

    monkeypatch.setattr(files, "write_json", slow)
    assert set(update_manifest(copy)["shards"]) == {"shard-00000.parquet", late.name}
    assert records.verify(copy) == []


def test_a_shard_of_another_kind_is_named_and_set_aside(data: dict[str, pathlib.Path], copy: pathlib.Path) -> None:
    stranger = shards.shard_path(copy, 2)
    shutil.copy(shards.shard_path(data["images"], 0), stranger)
    assert records.verify(copy) == [(stranger, "holds images episodes among push episodes")]
    with pytest.raises(UserError, match=r"shard-00002\.parquet holds images episodes among push"):
        records.load(copy, kind="push")
    assert records.repair(copy) == [stranger]
    assert not records.verify(copy) and records.summary(copy)["episodes"] == 24


def test_shards_with_other_numbers_of_slots_are_one_line(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    copy = pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))
    episodes = shards.read_shard(shards.shard_path(copy, 1), kind="push")
    scene = episodes.scene.replace(**{name: leaf[:, :2] for name, leaf in vars(episodes.scene).items()})
    fewer = episodes.replace(scene=scene, poses=episodes.poses[:, :, :2], after=episodes.after[:, :2])
    shards.write_shard(copy, 1, fewer, kind="push", config={}, faults={})
    (copy / MANIFEST).unlink()
    update_manifest(copy)
    with pytest.raises(UserError, match="shards with 2 and 3 object slots; want one number in a folder"):
        records.load(copy, kind="push")
