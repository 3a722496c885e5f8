"""A shard in object storage is there once somebody has created it; by a file:// URL."""

import pathlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from dipn_jax.errors import UserError
from dipn_jax.storage import manifest, mirror, places, records, shards
from dipn_jax.storage.objects import Bucket
from dipn_jax.storage.places import Place
from dipn_jax.system import files, temporary


@pytest.fixture
def there(data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """Return the folder that the URL names."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))


@pytest.fixture
def place(there: pathlib.Path) -> Iterator[Place]:
    with places.opened(pathlib.Path(f"file://{there}")) as opened:
        yield opened


def _write(place: Place, there: pathlib.Path, index: int, *, rows: int | None = None) -> dict[str, Any]:
    """Write a shard of the episodes of shard 0 as a worker does, and return its entry."""
    from dipn_jax import structs

    episodes = shards.read_shard(shards.shard_path(there, 0), kind="push")
    some = episodes if rows is None else structs.take(episodes, slice(0, rows))
    return shards.write_shard(place.folder, index, some, kind="push", config={"seed": 3}, faults={})


def test_a_shard_that_another_has_made_stays_and_is_listed_as_it_is(place: Place, there: pathlib.Path) -> None:
    before = manifest.entries(there)
    mine = _write(place, there, 0)
    assert mine != before["shard-00000.parquet"], "as another kind of processor would make it"
    assert place.commit(0, mine) == before["shard-00000.parquet"]
    assert place.list({"shard-00000.parquet": place.commit(0, _write(place, there, 0))})["shards"] == before
    assert records.verify(there) == [] and list(place.folder.glob("shard-*")) == []


def test_a_shard_of_fewer_episodes_is_replaced(place: Place, there: pathlib.Path) -> None:
    assert place.counts([0, 1, 2]) == {0: 16, 1: 8}
    place.forget([1, 2])
    assert list(manifest.listed(there)) == ["shard-00000.parquet"]
    made = {f"shard-0000{index}.parquet": place.commit(index, _write(place, there, index)) for index in (1, 2)}
    assert list(place.folder.glob("shard-*")) == [], "a job of many shards fills no disk"
    assert place.list(made)["episodes"] == 48 and records.verify(there) == []
    assert list(manifest.listed(there)) == [f"shard-0000{index}.parquet" for index in range(3)]


def test_shards_that_are_not_listed_are_looked_at_and_then_listed(place: Place, there: pathlib.Path) -> None:
    wanted = (there / "manifest.json").read_bytes()
    (there / "manifest.json").unlink()
    assert place.counts([1, 0]) == {0: 16, 1: 8} and place.entry(1) == manifest.entries(there)["shard-00001.parquet"]
    place.list({})
    assert (there / "manifest.json").read_bytes() == wanted
    shards.shard_path(there, 1).write_bytes(b"torn")
    with pytest.raises(UserError, match=r"shard-00001\.parquet: truncated.*; run dipn-datagen repair"):
        place.counts([0, 1])


@pytest.mark.parametrize("url", ["", "file://"])
def test_the_list_is_written_by_each_worker_that_finds_all_shards_there_and_by_no_other(
    url: str, there: pathlib.Path
) -> None:
    """A shard that is to be made longer is missing, though there is one of its name."""
    wanted = (there / "manifest.json").read_bytes()
    (there / "manifest.json").unlink()
    with places.opened(pathlib.Path(f"{url}{there}")) as place:
        said = f"{place.name}: 2 of {{}} shards are there; the worker that ends last lists them"
        assert places.end(place, {}, sizes={0: 16, 1: 8, 2: 8}, alone=False) == said.format(3)
        assert places.end(place, {}, sizes={0: 16, 1: 16}, alone=False) == said.format(2)
        assert not (there / "manifest.json").exists()
        for _ in range(2):  # both end at the same moment
            said = places.end(place, {}, sizes={0: 16, 1: 8}, alone=False)
            assert said == f"{place.name}: 24 push episodes in 2 shards"
            assert (there / "manifest.json").read_bytes() == wanted
    assert shards.shard_files(place.folder) == ([] if url else shards.shard_files(there))


def test_where_a_bucket_lists_a_shard_late_its_maker_knows_of_it_and_the_others_leave_the_list(
    place: Place, there: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listing, late = Bucket.list, "shard-00001.parquet"
    entry = manifest.entries(there)[late]
    wanted = (there / "manifest.json").read_bytes()
    (there / "manifest.json").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(Bucket, "list", lambda self: {k: v for k, v in listing(self).items() if k != late})
        assert ": 1 of 2 shards are there; " in places.end(place, {}, sizes={0: 16, 1: 8}, alone=False)
        assert not (there / "manifest.json").exists() and records.verify(there) == []
        assert ": 24 push episodes in 2 " in places.end(place, {late: entry}, sizes={0: 16, 1: 8}, alone=False)
    assert (there / "manifest.json").read_bytes() == wanted


def test_of_two_that_begin_at_once_the_second_compares(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one's configuration comes between the second's look and its own."""
    create = Bucket.create

    def later(self: Bucket, name: str, data: bytes) -> bool:
        monkeypatch.setattr(Bucket, "create", create)
        self.put(name, b'{"seed": 1}')
        return self.create(name, data)

    with places.opened(pathlib.Path(f"file://{tmp_path}/new")) as place:
        assert not place.begun()
        monkeypatch.setattr(Bucket, "create", later)
        with pytest.raises(UserError, match="begun with seed=1, asked for seed=2"):
            place.claim(lambda folder: files.claim(folder, {"seed": 2}))
        assert place.begun()
        place.claim(lambda folder: files.claim(folder, {"seed": 1}))
    assert not place.folder.exists()  # type: ignore[attr-defined]


def test_a_damaged_shard_is_set_aside(place: Place, there: pathlib.Path) -> None:
    url, path = f"file://{there}", shards.shard_path(there, 1)
    copy = mirror.local(url)
    shards.shard_path(copy, 0).write_bytes(b"x" * shards.shard_path(copy, 0).stat().st_size)  # nobody's but the copy's
    path.write_bytes(path.read_bytes()[:-1])
    assert [removed.name for removed in places.repair(url)] == [path.name]
    assert not path.exists() and path.with_name(f"{path.name}.damaged").is_file()
    assert list(manifest.listed(there)) == ["shard-00000.parquet"] and records.verify(mirror.local(url)) == []
    assert place.counts([0, 1]) == {0: 16}


def test_a_folder_is_rid_of_what_dead_processes_of_this_machine_left(tmp_path: pathlib.Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    mine, theirs = (tmp_path / f".shard.{host}-{ended.pid}-0a.tmp" for host in (temporary._host(), "elsewher"))
    for path in (mine, theirs):
        path.touch()
    places.Folder(tmp_path).claim(lambda _: None)
    assert theirs.exists() and not mine.exists()
