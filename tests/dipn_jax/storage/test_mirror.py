"""The copy of a data set in object storage is what is there, and only what is new of it is fetched."""

import pathlib
import shutil

import numpy as np
import pytest

import dipn_jax
from dipn_jax.errors import UserError
from dipn_jax.storage import manifest, mirror, records, shards
from dipn_jax.storage.objects import Bucket
from dipn_jax.system import files


@pytest.fixture
def there(data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """Return the folder that a file:// URL names; copies are made below another one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "bucket" / "push"))


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the list of the names of objects that are fetched."""
    names: list[str] = []
    get = Bucket.get
    monkeypatch.setattr(Bucket, "get", lambda self, name: (names.append(name), get(self, name))[1])
    return names


def _contents(folder: pathlib.Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*")}


def test_a_copy_is_read_as_the_data_set_and_fetched_once(there: pathlib.Path, fetched: list[str]) -> None:
    (there / "notes.txt").write_bytes(b"of somebody else")
    (there / "shard-00000.parquet#1").write_bytes(b"staged by another writer")
    episodes = dipn_jax.read_episodes(f"file://{there}")
    np.testing.assert_array_equal(episodes.scene.size, dipn_jax.read_episodes(there).scene.size)
    copy = mirror.local(f"file://{there}")
    wanted = {
        name: data for name, data in _contents(there).items() if not name.startswith(("notes", "shard-00000.parquet#"))
    }
    assert _contents(copy) == wanted and sorted(fetched) == sorted(wanted)
    assert copy.name == "push" and mirror.local(pathlib.Path(f"file://{there}")) == copy
    assert mirror.local(there) == there


def test_what_changes_there_changes_in_the_copy(there: pathlib.Path, fetched: list[str]) -> None:
    url = f"file://{there}"
    copy = mirror.local(url)
    fetched.clear()
    shards.shard_path(there, 1).unlink()
    manifest.update_manifest(there)
    mirror.local(url)
    assert fetched == ["manifest.json"] and "shard-00001.parquet" not in _contents(copy)
    episodes = shards.read_shard(shards.shard_path(there, 0), kind="push")
    shards.write_shard(there, 0, episodes, kind="push", config={"seed": 8}, faults={})
    mirror.local(url)
    assert fetched[1:] == ["shard-00000.parquet"]
    shards.shard_path(copy, 0).write_bytes(b"torn")
    mirror.local(url)
    assert fetched[2:] == ["shard-00000.parquet"]
    fetched.clear()
    (copy / mirror.INDEX).write_bytes(b"{")
    mirror.local(url)
    assert "shard-00000.parquet" in fetched and shards.count(shards.shard_path(copy, 0)) == 16


def test_a_shard_that_is_named_by_the_manifest_is_in_the_copy(
    there: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A generation ends while the copy is made."""
    late, listed = there.parent / "late", (there / "manifest.json").read_bytes()
    shards.shard_path(there, 1).rename(late)
    manifest.update_manifest(there)
    get = Bucket.get

    def getting(self: Bucket, name: str) -> object:
        if name == "manifest.json":
            late.rename(shards.shard_path(there, 1))
            files.write_atomically(there / "manifest.json", listed)
        return get(self, name)

    monkeypatch.setattr(Bucket, "get", getting)
    assert records.verify(mirror.local(f"file://{there}")) == []


def test_an_interrupted_copy_goes_on(there: pathlib.Path, fetched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    url, write = f"file://{there}", files.write_atomically
    monkeypatch.setattr(mirror, "OBJECTS_PER_INDEX_WRITE", 1)

    def interrupted(path: pathlib.Path, data: bytes) -> None:
        if path.name == "shard-00001.parquet":
            raise KeyboardInterrupt
        write(path, data)

    monkeypatch.setattr(files, "write_atomically", interrupted)
    with pytest.raises(KeyboardInterrupt):
        mirror.local(url)
    monkeypatch.setattr(files, "write_atomically", write)
    fetched.clear()
    assert _contents(mirror.local(url)) == _contents(there) and fetched == ["shard-00001.parquet"]


def test_where_there_is_nothing_or_no_home_is_said(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"^data set file:///.*/empty: no such data set; give a URL"):
        mirror.local(f"file://{tmp_path}/empty")
    monkeypatch.setenv("XDG_CACHE_HOME", "~nobody")
    with pytest.raises(UserError, match="there is no home folder to copy it to; set XDG_CACHE_HOME"):
        mirror.local(f"file://{tmp_path}/empty")
