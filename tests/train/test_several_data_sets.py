"""Several data sets for one training."""

import mmap
import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.train import cli, loop
from dipn_jax.train.configs import DEFAULT_COMPUTE, TrainConfig
from dipn_jax.train.grasp import GraspTask, PretrainTask
from dipn_jax.train.push import PushTask
from dipn_jax.train.split import load_split

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import manifest, records, shards
from dipn_jax.storage.on_demand import widened
from dipn_jax.storage.space import Space
from dipn_jax.structs import ABSENT
from dipn_jax.system import files

Data = dict[str, pathlib.Path]


@pytest.fixture
def wider(data: Data, tmp_path: pathlib.Path) -> Data:
    """Return data sets with the episodes of `data` in five slots instead of three, of masses that nobody sees."""
    made = {}
    for kind in ("push", "images"):
        made[kind] = tmp_path / f"wider-{kind}"
        made[kind].mkdir()
        episodes = widened(records.load(data[kind], kind=kind)[0], 5)
        mass = episodes.scene.mass * np.float32(1.01)  # else the scenes would be the same
        episodes = episodes.replace(scene=episodes.scene.replace(mass=mass))
        shards.write_shard(made[kind], 0, episodes, kind=kind, config={}, faults={})
        manifest.update_manifest(made[kind])
    return made


def test_pushes_of_several_data_sets_are_learnt_from(data: Data, wider: Data) -> None:
    task = PushTask((data["push"], wider["push"]), DipnConfig(), limit=None, centimetres=(5, 10))
    assert task.size == 40 and len(task.test_set) == 8 and task.slots == 5
    one, other = (task.prepare(task.train_set.take(slice(at, at + 2))) for at in (0, 20))
    np.testing.assert_array_equal(one.inputs.crops, other.inputs.crops)
    np.testing.assert_array_equal(one.target, other.target)
    assert not np.asarray(one.inputs.present)[:, 3:].any()
    alone = PushTask(data["push"], DipnConfig(), limit=None, centimetres=(5, 10))
    assert task.fingerprint.startswith(alone.fingerprint.split(":")[0]) and task.fingerprint != alone.fingerprint
    fewer = PushTask((data["push"], wider["push"]), DipnConfig(), limit=3, centimetres=(5,))
    np.testing.assert_array_equal(fewer.train_set.whole().poses, task.train_set.take(slice(0, 3)).poses)


def test_the_first_grasps_only_are_learnt_from(data: Data) -> None:
    task = GraspTask(data["grasp"], GraspConfig())
    fewer = GraspTask(data["grasp"], GraspConfig(), limit=3)
    assert fewer.size == 3 and fewer.fingerprint == f"{task.fingerprint}:3"
    np.testing.assert_array_equal(fewer.train_set.whole().poses, task.train_set.take(slice(0, 3)).poses)
    np.testing.assert_array_equal(fewer.test_set.whole().poses, task.test_set.whole().poses)
    with pytest.raises(UserError, match="--limit 21: want 1 to 20, the grasps of --data that are not held out"):
        GraspTask(data["grasp"], GraspConfig(), limit=21)


def test_the_last_tenth_of_each_is_held_out(data: Data, wider: Data) -> None:
    sides = load_split((data["push"], wider["push"]), kind="push")
    learnt, held_out = sides.learnt.whole(), sides.held_out.whole()
    half = np.split(held_out.poses, 2)
    np.testing.assert_array_equal(half[0][:, :, :3], half[1][:, :, :3])
    absent = learnt.scene.shape == ABSENT
    assert absent[:20, 3:].all() and not learnt.scene.size[absent].any(), "slots that are added are empty"
    np.testing.assert_array_equal(half[0][:, :, :3], records.load(data["push"], kind="push")[0].poses[20:])


def _in_a_file(array: Any) -> bool:
    """Return whether an array is a view of a file."""
    return isinstance(array, mmap.mmap) or (hasattr(array, "base") and _in_a_file(array.base))


@pytest.mark.parametrize("several", [False, True])
def test_what_memory_has_no_room_for_is_the_same_in_files(
    several: bool, data: Data, wider: Data, tmp_path: pathlib.Path
) -> None:
    folders = (data["push"], wider["push"]) if several else data["push"]
    half = lambda of, folder: np.arange(0, len(of), 2) if folder == data["push"] else None  # noqa: E731
    for choose in (lambda *_: None, half):
        sides = load_split(folders, kind="push", choose=choose)
        mapped = load_split(folders, kind="push", choose=choose, space=Space(0, tmp_path))
        assert (mapped.parts, mapped.fingerprint) == (sides.parts, sides.fingerprint)
        for one, other in ((sides.learnt, mapped.learnt), (sides.held_out, mapped.held_out)):
            assert one.slots == other.slots
            for leaf, in_file in zip(jax.tree.leaves(one.whole()), jax.tree.leaves(other.whole()), strict=True):
                assert leaf.dtype == in_file.dtype and _in_a_file(in_file) and not _in_a_file(leaf)
                np.testing.assert_array_equal(leaf, in_file)


def test_images_of_several_data_sets_are_learnt_from(data: Data, wider: Data) -> None:
    task = PretrainTask((data["images"], wider["images"]), GraspConfig(width=8))
    assert task.size == 6 and task.examples == 8 and len(task.test_set) == 2


def test_the_command_takes_several_folders_and_names_the_one_that_is_wrong(
    data: Data, wider: Data, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["push", "--data", str(wider["push"]), str(data["grasp"]), "--out", str(tmp_path / "r")]
    assert console.run("dipn-train", cli.COMMANDS, words) == 2
    assert "holds grasp episodes, want push" in capsys.readouterr().err
    words[3] = str(data["push"])
    assert console.run("dipn-train", cli.COMMANDS, [*words, "--mix", "1"]) == 2
    assert "--mix 1: want a number for each folder of --data, 2" in capsys.readouterr().err
    assert not (tmp_path / "r" / "config.json").exists()
    with pytest.raises(UserError, match="want at least one folder of dipn-datagen push"):
        load_split((), kind="push")


def _scenes(episodes: Any) -> list[bytes]:
    """Return what tells scenes apart: the sizes, masses and frictions of the three objects of each."""
    leaves = (episodes.scene.size, episodes.scene.mass, episodes.scene.friction)
    return [b"".join(leaf[:3].tobytes() for leaf in row) for row in zip(*leaves, strict=True)]


@pytest.mark.parametrize("slots", [3, 5])
@pytest.mark.parametrize("every", [1, 2])
def test_what_one_data_set_holds_out_is_not_learnt_from_another(
    slots: int, every: int, data: Data, tmp_path: pathlib.Path
) -> None:
    """The other has the first scenes of one, and less of them, so that it holds out others."""
    episodes = structs.take(records.load(data["push"], kind="push")[0], slice(4, 24))
    other = widened(structs.take(episodes, np.r_[8:20, 0:8]), slots)
    (tmp_path / "other").mkdir()
    shards.write_shard(tmp_path / "other", 0, other, kind="push", config={}, faults={})
    manifest.update_manifest(tmp_path / "other")
    folders = (data["push"], tmp_path / "other")
    choose = lambda of, _: None if every == 1 else np.arange(0, len(of), every)  # noqa: E731
    alone = [load_split(folder, kind="push", choose=choose) for folder in folders]
    held = {scene for one in alone for scene in _scenes(one.held_out.whole())}
    number = sum(scene in held for one in alone for scene in _scenes(one.learnt.whole()))
    assert number > 1
    with pytest.raises(UserError) as said:
        load_split(folders, kind="push", choose=choose)
    assert str(said.value) == (
        f"--data: {number} episodes would be learnt from whose scenes another of these data sets holds out; give one "
        "of them, or make one with another --seed"
    )


def test_a_mix_belongs_to_a_run_and_runs_without_one_go_on(data: Data, wider: Data, tmp_path: pathlib.Path) -> None:
    task = PushTask((data["push"], wider["push"]), DipnConfig(), limit=None, centimetres=(5,))
    plain, mixed = (loop._identity(task, TrainConfig(mix=mix), DEFAULT_COMPUTE, None) for mix in ((), (1.0, 3.0)))
    assert {**mixed, "mix": ()} == {**plain, "mix": ()} and "mix" not in plain
    files.claim(tmp_path, mixed)
    files.claim(tmp_path, mixed)
    with pytest.raises(UserError, match="mix"):
        files.claim(tmp_path, plain)
