"""What a training learns from and holds out, and its batches, are those of data sets that are read whole."""

import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.train.grasp import GraspTask, PretrainTask
from dipn_jax.train.push import PushTask
from dipn_jax.train.split import load_split

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import manifest, shards
from dipn_jax.storage.on_demand import DataSet
from dipn_jax.storage.space import Space
from dipn_jax.structs import ABSENT
from dipn_jax.world import shapes

Data = dict[str, pathlib.Path]
DISTANCES = (5, 10)


def whole(folder: pathlib.Path, kind: str) -> Any:
    """Return the episodes of all shards."""
    return structs.concatenate([shards.read_shard(path, kind=kind) for path in shards.shard_files(folder)])


def cut(size: np.ndarray) -> int:
    """Return how many of episodes with these sizes are learnt from."""
    begun = [at for at in range(1, len(size)) if (size[at] != size[at - 1]).any()]
    wanted = len(size) - max(1, len(size) // 10)
    return min(begun, key=lambda at: (abs(at - wanted), at))


@pytest.fixture
def two(data: Data, tmp_path: pathlib.Path) -> tuple[pathlib.Path, ...]:
    """Return two data sets of pushes: that of `data`, and one of two slots, other masses and shards of five."""
    folder, found = tmp_path / "narrow", whole(data["push"], "push")
    folder.mkdir()
    scene = structs.take(found.scene, slice(None)).replace(mass=found.scene.mass * np.float32(1.01))
    scene = jax.tree.map(lambda leaf: leaf[:, :2], scene)
    found = found.replace(scene=scene, poses=found.poses[:, :, :2], after=found.after[:, :2])
    for number, begin in enumerate(range(0, 19, 5)):
        some = structs.take(found, slice(begin, min(begin + 5, 19)))
        shards.write_shard(folder, number, some, kind="push", config={}, faults={})
    manifest.update_manifest(folder)
    return data["push"], folder


def _odd(of: DataSet, folder: pathlib.Path) -> np.ndarray:
    """Choose episodes of which some shards have none."""
    return np.array([*range(1, 5), *range(9, len(of), 2)])


def _equal(found: Any, wanted: Any) -> None:
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def _wider(episodes: Any) -> Any:
    """Return pushes with one slot more, which is empty."""
    scene = jax.tree.map(lambda leaf: np.concatenate([leaf, np.zeros_like(leaf[:, :1])], 1), episodes.scene)
    scene.shape[:, -1] = ABSENT
    parked = np.array([5, 5, 1, 1, 0, 0, 0], np.float32)  # where empty slots are
    poses, after = (
        np.concatenate([leaf, np.broadcast_to(parked, (*leaf.shape[:-2], 1, 7))], -2)
        for leaf in (episodes.poses, episodes.after)
    )
    return episodes.replace(scene=scene, poses=poses, after=after)


def _reference(folders: tuple[pathlib.Path, ...], chosen: bool, limit: int | None) -> tuple[Any, Any, list[int]]:
    """Return what is learnt from, what is held out, and how many are learnt of each data set."""
    learnt, held, parts = [], [], []
    for folder in folders:
        episodes = whole(folder, "push")
        if chosen:
            episodes = structs.take(episodes, np.array([*range(1, 5), *range(9, len(episodes.fault), 2)]))
        at = cut(episodes.scene.size)
        if len(folders) == 2 and episodes.scene.shape.shape[1] == 2:  # the other has three slots
            episodes = _wider(episodes)
        learnt.append(structs.take(episodes, slice(0, at)))
        held.append(structs.take(episodes, slice(at, None)))
        parts.append(at if limit is None else max(0, min(at, limit - sum(parts))))
    return structs.take(structs.concatenate(learnt), slice(0, limit)), structs.concatenate(held), parts


@pytest.mark.parametrize("less", [None, 1, 7])
@pytest.mark.parametrize("chosen", [False, True])
@pytest.mark.parametrize("in_files", [False, True])
@pytest.mark.parametrize("which", [(0,), (1,), (0, 1), (1, 0)])
def test_both_sides_are_those_of_reading_whole(
    which: tuple[int, ...],
    in_files: bool,
    chosen: bool,
    less: int | None,
    two: tuple[pathlib.Path, ...],
    tmp_path: pathlib.Path,
) -> None:
    folders = tuple(two[one] for one in which)
    choose = _odd if chosen else lambda *_: None
    space = Space(0, tmp_path / "files") if in_files else None
    limit = None if less is None else sum(_reference(folders, chosen, None)[2]) - less
    sides = load_split(folders, kind="push", choose=choose, limit=limit, space=space)
    learnt, held, parts = _reference(folders, chosen, limit)
    assert sides.parts == tuple(parts) and len(sides.learnt) == sum(parts) == len(learnt.fault)
    index = np.random.default_rng(0).permutation(len(learnt.fault))[:5]
    _equal(sides.learnt.take(index), structs.take(learnt, index))
    _equal(sides.held_out.whole(), held)
    _equal(sides.learnt.whole(), learnt)


def test_a_limit_is_one_of_what_is_learnt_from(two: tuple[pathlib.Path, ...]) -> None:
    for limit in (0, 37):
        with pytest.raises(UserError, match=f"--limit {limit}: want 1 to 36, the pushes of --data that are not held"):
            load_split(two, kind="push", what="pushes", limit=limit)
    assert load_split(two, kind="push", limit=36).parts == (20, 16)


def _noted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the shards that are read from now on, as they are read."""
    read, own = list[str](), shards.read_shard

    def noting(path: pathlib.Path, **options: Any) -> Any:
        read.append(f"{path.parent.name}/{path.name}")
        return own(path, **options)

    monkeypatch.setattr(shards, "read_shard", noting)
    return read


def test_batches_of_pushes_are_those_of_reading_whole_and_read_no_more(
    two: tuple[pathlib.Path, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    learnt, _, (first, _) = _reference(two, False, None)
    read = _noted(monkeypatch)
    task = PushTask(two, DipnConfig(), limit=None, centimetres=DISTANCES)
    assert read == []
    rows = np.array([16, 17, 18, 19, first, first + 1])
    found, wanted = task.fetch(rows), task.prepare(structs.take(learnt, np.resize(rows, 16)))
    assert sorted(read) == ["narrow/shard-00000.parquet", "push/shard-00001.parquet"]
    np.testing.assert_array_equal(found.inputs.crops, np.asarray(wanted.inputs.crops).astype(np.float16)[:6])
    np.testing.assert_array_equal(found.target, wanted.target[:6])
    np.testing.assert_array_equal(found.taught, wanted.taught[:6])


def test_scenes_without_some_classes_are_those_of_reading_whole(data: Data) -> None:
    episodes, tried = whole(data["push"], "push"), 0
    for number, name in enumerate(shapes.CLASSES):
        kept = structs.take(episodes, (episodes.scene.shape != number).all(1))
        if not 4 < len(kept.fault) < len(episodes.fault):  # too few scenes to be split, or nothing is left out
            continue
        at, tried = cut(kept.scene.size), tried + 1
        task = PushTask(data["push"], DipnConfig(), limit=None, centimetres=DISTANCES, without=(name,))
        _equal(task.train_set.whole(), structs.take(kept, slice(0, at)))
        _equal(task.test_set.whole(), structs.take(kept, slice(at, None)))
    assert tried


@pytest.mark.parametrize("task", [GraspTask, PretrainTask])
def test_other_trainings_read_what_they_fetch(task: Any, data: Data, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = "grasp" if task is GraspTask else "images"
    episodes = whole(data[kind], kind)
    at, read = cut(episodes.scene.size), _noted(monkeypatch)
    made = task(data[kind], GraspConfig(width=8))
    assert read == [] and made.size == at
    index = np.array([at - 1, 0])
    found, wanted = made.fetch(index), structs.take(episodes, index)
    if task is GraspTask:
        np.testing.assert_array_equal(found.target, wanted.success)
        np.testing.assert_array_equal(found.color, wanted.scene.color)
    else:
        _equal(found, wanted)
    assert set(read) == {f"{kind}/{path.name}" for path in shards.shard_files(data[kind])}
    _equal(made.test_set.whole(), structs.take(episodes, slice(at, None)))
