"""Episodes are those of reading whole; of the shards, those that are needed are read, each once."""

import pathlib
import threading
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.storage import manifest, on_demand, records, shards
from dipn_jax.storage.on_demand import DataSet, Episodes, widened
from dipn_jax.storage.space import Space

ROWS = 3
"""Episodes in a shard of the data sets here; the last one has fewer."""
_read = shards.read_shard
Write = Callable[..., tuple[pathlib.Path, Any]]


@pytest.fixture
def write(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> Write:
    """Return a function that writes the first episodes of `data`, with more slots, and returns folder and episodes."""

    def make(count: int, *, kind: str = "push", more: int = 0) -> tuple[pathlib.Path, Any]:
        folder = tmp_path / f"{kind}-{count}-{more}"
        folder.mkdir()
        found = structs.concatenate([_read(path, kind=kind) for path in shards.shard_files(data[kind])])
        episodes = widened(structs.take(found, slice(0, count)), found.scene.shape.shape[1] + more)
        for number, begin in enumerate(range(0, count, ROWS)):
            some = structs.take(episodes, slice(begin, min(begin + ROWS, count)))
            shards.write_shard(folder, number, some, kind=kind, config={}, faults={})
        manifest.update_manifest(folder)
        return folder, episodes

    return make


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the shards that are read from now on, as they are read."""
    names = list[str]()

    def noting(path: pathlib.Path, **options: Any) -> Any:
        names.append(path.name)
        return _read(path, **options)

    monkeypatch.setattr(shards, "read_shard", noting)
    return names


def equal(found: Any, wanted: Any) -> None:
    """Check that two structs are the same, types included."""
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def opened(folder: pathlib.Path, kind: str = "push") -> DataSet:
    return records.opened(folder, kind=kind)


def test_the_shards_of_the_rows_taken_are_read_and_each_once(write: Write, read: list[str]) -> None:
    folder, whole = write(11)
    of = opened(folder)
    episodes = Episodes([(of, range(11))], Space())
    assert len(of) == len(episodes) == 11 and of.slots == episodes.slots == 3 and read == []
    for index, numbers in (([4, 3, 4], [1]), ([10], [3]), ([5, 9, 2], [0]), ([], [])):
        del read[:]
        equal(episodes.take(np.array(index, int)), structs.take(whole, np.array(index, int)))
        assert sorted(read) == [f"shard-{number:05d}.parquet" for number in numbers]
    del read[:]
    equal(episodes.take(slice(1, 9, 3)), structs.take(whole, slice(1, 9, 3)))
    assert read == ["shard-00002.parquet"]
    equal(episodes.whole(), whole)
    assert read == ["shard-00002.parquet"]
    for index in (11, -1):
        with pytest.raises(IndexError, match=f"episodes {index} to {index} of 11"):
            episodes.take(np.array([index]))


@pytest.mark.parametrize("kind", ["push", "grasp", "images"])
def test_a_whole_data_set_is_what_its_shards_hold_one_after_another(kind: str, write: Write) -> None:
    folder, whole = write(4, kind=kind)
    equal(records.read_episodes(folder), whole)
    table = pq.read_table(folder / "shard-00000.parquet")
    for name in ("held", "success") if kind == "grasp" else ():
        np.testing.assert_array_equal(getattr(whole, name)[:ROWS].reshape(ROWS, -1), table[name].to_pylist())


@pytest.mark.parametrize("in_files", [False, True])
def test_chosen_episodes_of_several_data_sets_have_the_slots_of_the_widest(
    in_files: bool, write: Write, read: list[str], tmp_path: pathlib.Path
) -> None:
    (narrow, few), (wide, many) = write(11), write(8, more=2)
    numbers = np.array([0, 4, 5, 7])
    parts = [(opened(narrow), range(4, 11)), (opened(wide), numbers), (opened(narrow), range(0, 0))]
    episodes = Episodes(parts, Space(0 if in_files else np.inf, tmp_path))
    wanted = structs.concatenate([widened(structs.take(few, slice(4, 11)), 5), structs.take(many, numbers)])
    assert len(episodes) == 11 and episodes.slots == 5 and isinstance(episodes._whole.poses, np.memmap) == in_files
    index = np.array([7, 0, 10, 1])
    equal(episodes.take(index), structs.take(wanted, index))
    assert sorted(read) == [f"shard-{number:05d}.parquet" for number in (0, 1, 2)]
    equal(episodes.whole(), wanted)
    none = Episodes([(parts[0][0], range(0, 0)), parts[1]], Space())
    assert none.slots == 5 and Episodes([(parts[0][0], numbers), (parts[1][0], range(0, 0))], Space()).slots == 5
    equal(none.whole(), structs.take(many, numbers))


def test_a_column_is_read_of_the_shards_that_hold_the_rows(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, whole = write(11)
    of, names, own = opened(folder), list[tuple[str, list[str]]](), shards._decoded

    def noting(path: pathlib.Path, meta: Any, columns: Any, **options: Any) -> Any:
        names.append((path.name, list(columns)))
        return own(path, meta, columns, **options)

    monkeypatch.setattr(shards, "_decoded", noting)
    np.testing.assert_array_equal(of.column("scene.size", range(2, 5)), whole.scene.size[2:5])
    assert sorted(names) == [(f"shard-0000{number}.parquet", ["scene.size"]) for number in (0, 1)]
    np.testing.assert_array_equal(of.column("push.distance"), whole.push.distance)
    np.testing.assert_array_equal(of.column("poses", np.array([1, 10])), whole.poses[[1, 10]])
    assert of.column("scene.shape", range(3, 3)).shape == (0, 3)
    for rows in (range(2, 5), None, np.array([1, 10]), range(3, 3)):
        assert of.column("scene.shape", rows).dtype == whole.scene.shape.dtype


def test_two_threads_read_a_shard_once_and_neither_gets_rows_that_are_not_there(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, whole = write(11)
    episodes = Episodes([(opened(folder), range(11))], Space())
    calls, begun, go_on, found = list[str](), threading.Event(), threading.Event(), dict[int, Any]()

    def slow(path: pathlib.Path, **options: Any) -> Any:
        calls.append(path.name)
        begun.set()
        assert go_on.wait(60)
        return _read(path, **options)

    def take(number: int) -> None:
        found[number] = episodes.take(np.array([0, 4]))

    monkeypatch.setattr(shards, "read_shard", slow)
    threads = [threading.Thread(target=take, args=(number,)) for number in range(2)]
    threads[0].start()
    assert begun.wait(60)
    threads[1].start()
    threads[1].join(0.2)
    assert not found, "both wait"
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert sorted(calls) == ["shard-00000.parquet", "shard-00001.parquet"]
    for taken in found.values():
        equal(taken, structs.take(whole, np.array([0, 4])))
    assert len(found) == 2


def test_a_shard_that_was_changed_meanwhile_is_one_line_and_the_others_can_be_taken(write: Write) -> None:
    folder, whole = write(11)
    episodes = Episodes([(opened(folder), range(11))], Space())
    changed, gone = (shards.shard_path(folder, number) for number in (1, 2))
    changed.write_bytes(shards.shard_path(folder, 0).read_bytes())  # another shard of as many episodes
    gone.unlink()
    for _ in range(2):  # it is not taken for read
        with pytest.raises(UserError, match=r"shard-00001\.parquet: was changed since it was checked; leave a"):
            episodes.take(np.array([0, 4]))
    with pytest.raises(UserError, match=r"shard-00002\.parquet: not found; generate it again"):
        episodes.take(np.array([7]))
    equal(episodes.take(np.array([0, 10])), structs.take(whole, np.array([0, 10])))


def test_progress_is_shown_while_many_shards_are_read_whole(
    write: Write, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = write(11)
    records.load(folder, kind="push")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(on_demand, "PROGRESS_SHARDS", 4)
    Episodes([(opened(folder), range(11))], Space()).take(np.arange(11))
    assert capsys.readouterr().err == ""
    records.load(folder, kind="push")
    assert "read push: 4/4 shards" in capsys.readouterr().err
