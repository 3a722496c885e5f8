"""What an export promises whatever its format: splits, interruption, refusals, the card."""

import json
import pathlib
import shutil
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dipn_jax.datagen import cli
from dipn_jax.datagen.exporting import columns, export, rendering, source
from dipn_jax.train.split import load_split

from dipn_jax.commands import console
from dipn_jax.sight import render
from dipn_jax.storage import manifest, records, shards
from dipn_jax.system import files

FORMATS = ("parquet", "npz", "hdf5", "zarr", "lerobot")
Data = dict[str, pathlib.Path]


def run(*words: object) -> int:
    return console.run("dipn-datagen", cli.COMMANDS, ["export", *map(str, words)])


def contents(folder: pathlib.Path) -> dict[str, bytes]:
    """Return the files of a folder, but for the card, which names the folder."""
    found = [path for path in folder.rglob("*") if path.is_file() and path.name != "README.md"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def needs(form: str) -> None:
    for package in export.NEEDS.get(form, ()):
        pytest.importorskip(package)


@pytest.mark.parametrize("kind", ["push", "grasp", "images"])
def test_splits_are_those_of_training_and_scenes_are_numbered(kind: str, data: Data) -> None:
    found = source.open_source(data[kind])
    episodes, fingerprint = records.load(data[kind], kind=kind)
    sides_of_training = load_split(data[kind], kind=kind)
    learnt, held = sides_of_training.learnt.whole(), sides_of_training.held_out.whole()
    assert found.fingerprint == fingerprint and found.count == len(episodes.fault)
    sides = {name: [found.read(part) for part in found.parts() if part.split == name] for name in source.SPLITS}
    for name, wanted in (("train", learnt), ("test", held)):
        for field in ("poses", "fault"):
            joined = np.concatenate([np.asarray(getattr(some, field)) for some, _, _ in sides[name]])
            np.testing.assert_array_equal(joined, getattr(wanted, field))
    numbers, scenes = (np.concatenate([one[at] for side in sides.values() for one in side]) for at in (1, 2))
    np.testing.assert_array_equal(numbers, np.arange(found.count))
    size = episodes.scene.size
    same = (size[1:] == size[:-1]).all((1, 2))
    np.testing.assert_array_equal(np.diff(scenes), ~same)
    assert scenes[0] == 0 and scenes[-1] > 0


def test_a_scene_that_goes_on_in_the_next_shard_keeps_its_number(data: Data, tmp_path: pathlib.Path) -> None:
    """Shards of 5 and 4 pushes, four of a scene: the second scene is in both, and ends the first of two shards."""
    episodes, _ = records.load(data["push"], kind="push")
    rows = np.concatenate([np.zeros(4, int), np.full(5, 4)])
    for index, some in enumerate((rows[:5], rows[5:])):
        shards.write_shard(tmp_path, index, episodes[some], kind="push", config={}, faults={})
    manifest.update_manifest(tmp_path)
    found = source.open_source(tmp_path)
    assert found.cut == 4 and [part.name for part in found.parts()] == ["train-00000", "test-00000", "test-00001"]
    scenes = [found.read(part)[2].tolist() for part in found.parts()]
    assert scenes == [[0] * 4, [1], [1] * 4]


@pytest.mark.parametrize("form", FORMATS)
def test_an_interrupted_export_ends_as_an_undisturbed_one(
    form: str, data: Data, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs(form)
    assert run(data["push"], "--out", tmp_path / "whole", "--format", form) == 0
    read, calls = source.Source.read, list[str]()

    def stop(self: source.Source, part: source.Part) -> Any:
        calls.append(part.name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return read(self, part)

    monkeypatch.setattr(source.Source, "read", stop)
    assert run(data["push"], "--out", tmp_path / "twice", "--format", form) == 130
    assert not (tmp_path / "twice" / "README.md").exists(), "the card comes last"
    assert not list((tmp_path / "twice").rglob("*.tmp")) and not (tmp_path / "twice" / "owner.json").exists()
    for place in ("", "meta", "data/poses") if form == "zarr" else ():  # where a process may have been killed
        (tmp_path / "twice" / "train.zarr" / place / ".zattrs.0a1b.partial").touch()
    assert run(data["push"], "--out", tmp_path / "twice", "--format", form) == 0
    assert calls.count("train-00000") == 1, "what is written is not read again"
    assert len(calls) == 4
    assert contents(tmp_path / "whole") == contents(tmp_path / "twice")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "twice" / "data").rglob("*") if path.is_file()}
    assert run(data["push"], "--out", tmp_path / "twice", "--format", form) == 0
    assert before == {path: path.stat().st_mtime_ns for path in before}, "a whole export is left as it is"


def test_a_part_is_written_whole_or_not_at_all(
    data: Data, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures are drawn block by block; it ends in the second of the first part."""
    draw, drawn_so_far = rendering.draw, list[int]()

    def stop(episodes: Any, images: str) -> columns.Values:
        drawn_so_far.append(len(episodes.fault))
        if len(drawn_so_far) == 2:
            raise KeyboardInterrupt
        return draw(episodes, images)

    monkeypatch.setattr(rendering, "draw", stop)
    for form in ("parquet", "npz"):
        drawn_so_far.clear()
        out = tmp_path / form
        assert run(data["push"], "--out", out, "--format", form, "--images", "all") == 130
        assert drawn_so_far == [5, 5]
        assert [path.name for path in out.rglob("*") if path.is_file()] == ["config.json"]


def test_what_cannot_be_exported_is_one_line(
    data: Data, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(says: str, *words: object) -> None:
        assert run(*words) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error, error

    out = ("--out", tmp_path / "e")
    refused("no manifest.json", tmp_path, *out)
    refused("grasp episodes are single frames", data["grasp"], *out, "--format", "lerobot")
    both = "have none or all, a picture of every step; give one of these, or --format parquet or npz"
    for form in ("hdf5", "lerobot"):
        refused(
            f"--images both: push episodes as {form} {both}\n", data["push"], *out, "--format", form, "--images", "both"
        )
    refused("grasp episodes as parquet have none or before or after or both", data["grasp"], *out, "--images", "all")
    refused(
        "as npz have none or before; give one of these\n", data["images"], *out, "--format", "npz", "--images", "after"
    )
    refused("holds a data set", data["push"], "--out", data["push"])
    monkeypatch.setitem(export.NEEDS, "hdf5", ("h5py", "no_such_package"))
    refused("needs no_such_package; run pip install", data["push"], *out, "--format", "hdf5")
    copy = pathlib.Path(shutil.copytree(data["push"], tmp_path / "damaged"))
    path = shards.shard_path(copy, 1)
    path.write_bytes(path.read_bytes()[:-9])
    refused("shard-00001.parquet", copy, *out)
    assert not (tmp_path / "e").exists()
    assert run(data["push"], *out) == 0
    capsys.readouterr()
    refused("begun with export=parquet, asked for export=npz", data["push"], *out, "--format", "npz")
    refused("begun with images=none, asked for images=both", data["push"], *out, "--images", "both")
    refused("begun with kind=push, asked for kind=grasp", data["grasp"], *out)


def test_the_card_says_what_there_is_and_how_it_was_made(data: Data, tmp_path: pathlib.Path) -> None:
    copy = pathlib.Path(shutil.copytree(data["push"], tmp_path / "my ``` data"))
    files.write_json(copy / "asked.json", {"command": ["push", "--seed", "7 ```` # x"], "of": 1})
    assert run(copy, "--out", tmp_path / "e") == 0
    text = (tmp_path / "e" / "README.md").read_text()
    assert text.startswith("---\nlicense: apache-2.0\n") and "path: data/test-*.parquet" in text
    assert "| train | 20 |" in text and "| test | 4 |" in text and "# 24 pushes" in text
    schema = pq.read_schema(tmp_path / "e" / "data" / "train-00000.parquet")
    for name in schema.names:
        assert f"| `{name}` |" in text, name
    assert "`````bash\ndipn-datagen push --seed '7 ```` # x'\ndipn-datagen export " in text, "a fence that holds"
    said = json.loads(text.split("```json\n")[1].split("\n```")[0])
    assert said["config"]["seed"] == 0 and said["made_by"][0]["versions"]["mujoco"]
    assert records.load(copy, kind="push")[1] in text


def test_every_column_has_the_type_and_the_shape_that_it_is_said_to_have(data: Data) -> None:
    for kind, images in (("push", "both"), ("grasp", "after"), ("images", "before"), ("push", "all")):
        found = source.open_source(data[kind])
        episodes, numbers, scenes = found.read(found.parts()[-1])
        some = episodes[:1]
        values = columns.values(kind, some, numbers[:1], scenes[:1]) | rendering.draw(some, images)
        wanted = columns.of_episodes(kind, images)
        assert list(values) == [column.name for column in wanted]
        for column in wanted:
            assert values[column.name].dtype == column.dtype, column
            assert values[column.name].shape == (1, *column.lengths(found.slots)), column


def test_pictures_are_what_the_camera_sees(data: Data) -> None:
    pushes, _ = records.load(data["push"], kind="push")
    some = pushes[:2]
    before, after = some.poses[:, 0], some.after
    assert np.abs(before - some.poses[:, 10]).max() > 0.01
    for images, moment, poses in (
        ("all", "all", some.poses[:, 10]),
        ("both", "after", after),
        ("before", "before", before),
    ):
        values = rendering.draw(some, images)
        seen = render.observe(some.scene, poses)
        at = (slice(None), 10) if images == "all" else ()
        np.testing.assert_array_equal(values[f"height_{moment}"][at], seen.height)
        np.testing.assert_array_equal(values[f"label_{moment}"][at], seen.label)
        np.testing.assert_allclose(values[f"color_{moment}"][at] / 255, seen.color, atol=0.5 / 255)
