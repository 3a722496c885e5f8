"""Exports opened by the programs that they are for, and compared with the records."""

import json
import pathlib
import shutil
import subprocess
import sys
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from dipn_jax.datagen import cli
from dipn_jax.datagen.exporting import steps
from dipn_jax.train.split import load_split

from dipn_jax.commands import console
from dipn_jax.sight import render
from dipn_jax.storage import records

Data = dict[str, pathlib.Path]


def exported(data: Data, kind: str, out: pathlib.Path, form: str, images: str = "none") -> pathlib.Path:
    words = [str(data[kind]), "--out", str(out), "--format", form, "--images", images]
    assert console.run("dipn-datagen", cli.COMMANDS, ["export", *words]) == 0
    return out


@pytest.fixture(scope="module")
def table(data: Data, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the pushes as Parquet."""
    return exported(data, "push", tmp_path_factory.mktemp("e") / "table", "parquet")


@pytest.fixture(scope="module")
def pushes(data: Data) -> Any:
    return records.load(data["push"], kind="push")[0]


def test_pandas(table: pathlib.Path, pushes: Any) -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.concat([pandas.read_parquet(table / "data" / f"{n}.parquet") for n in _names(table)])
    np.testing.assert_array_equal(frame.push_angle, pushes.push.angle)
    np.testing.assert_array_equal(np.stack(frame.poses_11xNx7).reshape(-1, 11, 3, 7), pushes.poses)


def test_polars(table: pathlib.Path, pushes: Any) -> None:
    polars = pytest.importorskip("polars")
    frame = polars.read_parquet(table / "data" / "train-*.parquet")
    np.testing.assert_array_equal(frame["push_x"], pushes.push.start[:20, 0])
    np.testing.assert_array_equal(frame["size_Nx3"].to_numpy().reshape(-1, 3, 3), pushes.scene.size[:20])
    assert frame["push_distance"].dtype == polars.Float32 and frame["scene"].n_unique() == 5


def test_duckdb(table: pathlib.Path, pushes: Any) -> None:
    duckdb = pytest.importorskip("duckdb")
    rows = duckdb.sql(f"SELECT episode, mass_N[1], push_y FROM '{table}/data/*.parquet' ORDER BY episode").fetchall()
    number, mass, y = (np.array(column) for column in zip(*rows, strict=True))
    np.testing.assert_array_equal(number, np.arange(24))
    np.testing.assert_array_equal(mass.astype(np.float32), pushes.scene.mass[:, 0])
    np.testing.assert_array_equal(y.astype(np.float32), pushes.push.start[:, 1])


def test_hugging_face_datasets(table: pathlib.Path, pushes: Any, tmp_path: pathlib.Path) -> None:
    datasets = pytest.importorskip("datasets")
    loaded = datasets.load_dataset(str(table), cache_dir=str(tmp_path))
    assert {name: len(one) for name, one in loaded.items()} == {"train": 20, "test": 4}
    found = np.array(loaded["test"].with_format("numpy")["after_Nx7"]).reshape(-1, 3, 7)
    np.testing.assert_array_equal(found, pushes.after[20:])


def _names(table: pathlib.Path) -> list[str]:
    return sorted((path.stem for path in (table / "data").iterdir()), key=lambda name: (name < "train", name))


def test_names_in_tables_are_plain_and_numbers_are_in_metres(table: pathlib.Path, pushes: Any) -> None:
    """PyArrow alone, which is always there."""
    assert [path.name for path in sorted((table / "data").iterdir())] == [
        "test-00000.parquet", "train-00000.parquet", "train-00001.parquet",
    ]  # fmt: skip
    read = [pq.read_table(table / "data" / f"{name}.parquet") for name in ("train-00000", "train-00001", "test-00000")]
    for name in read[0].column_names:
        assert name.replace("_", "").isalnum(), name
    for name, wanted in (
        ("poses_11xNx7", pushes.poses),
        ("after_Nx7", pushes.after),
        ("size_Nx3", pushes.scene.size),
        ("color_Nx3", pushes.scene.color),
        ("friction_N", pushes.scene.friction),
        ("shape_N", pushes.scene.shape),
        ("push_y", pushes.push.start[:, 1]),
        ("push_distance", pushes.push.distance),
        ("fault", pushes.fault),
    ):
        flat = np.concatenate([np.array(one.column(name).to_pylist()) for one in read])
        assert read[0].schema.field(name).type in ("float", "int32") or wanted.ndim > 1, name
        np.testing.assert_array_equal(flat.astype(wanted.dtype).reshape(wanted.shape), wanted, err_msg=name)


def test_numpy(data: Data, tmp_path: pathlib.Path) -> None:
    sides = load_split(data["grasp"], kind="grasp")
    learnt, held = sides.learnt.whole(), sides.held_out.whole()
    out = exported(data, "grasp", tmp_path / "npz", "npz", images="both")
    files = [sorted((out / "data").glob(f"{name}-*.npz")) for name in ("train", "test")]
    for paths, wanted in zip(files, (learnt, held), strict=True):
        read = [np.load(path, allow_pickle=False) for path in paths]
        for name, value in (("held", wanted.held), ("success", wanted.success), ("after", wanted.after)):
            np.testing.assert_array_equal(np.concatenate([one[name] for one in read]), value)
        np.testing.assert_array_equal(np.concatenate([one["grasp_height"] for one in read]), wanted.grasp.height)
        assert read[0]["color_after"].shape[1:] == (224, 224, 3) and read[0]["color_after"].dtype == np.uint8
        assert read[0]["height_before"].max() > 0.02, "metres"


def test_robomimics_layout(data: Data, pushes: Any, tmp_path: pathlib.Path) -> None:
    h5py = pytest.importorskip("h5py")
    out = exported(data, "push", tmp_path / "h", "hdf5", images="all")
    assert not (out / "parts").exists()
    with h5py.File(out / "data.hdf5") as file:
        assert file["data"].attrs["total"] == 24 * 11 and json.loads(file["data"].attrs["env_args"])["env_name"]
        masks = [[name.decode() for name in file[f"mask/{name}"]] for name in ("train", "valid")]
        assert masks == [[f"demo_{i}" for i in range(20)], [f"demo_{i}" for i in range(20, 24)]]
        assert set(file["data"]) == set(masks[0]) | set(masks[1])
        demo = file["data/demo_17"]
        assert demo.attrs["num_samples"] == 11 and len(demo["rewards"]) == 11
        np.testing.assert_array_equal(demo["obs/poses"], pushes.poses[17])
        np.testing.assert_array_equal(demo["episode/after"], pushes.after[17])
        assert list(demo["dones"]) == [False] * 10 + [True]
        assert demo["obs/color"].shape == (11, 224, 224, 3) and demo["obs/label"].dtype == np.int8
        _check_path(demo["obs/gripper"][:], demo["actions"][:], pushes[17].push)


def _check_path(gripper: np.ndarray, action: np.ndarray, push: Any) -> None:
    """Check that the gripper goes a centimetre a step along a push, and that an action is where it is next."""
    along = np.array([np.cos(push.angle), np.sin(push.angle)])
    np.testing.assert_allclose(gripper[:, :2], push.start + 0.01 * np.arange(11)[:, None] * along, atol=1e-6)
    np.testing.assert_array_equal(action[:-1], gripper[1:])
    np.testing.assert_array_equal(action[-1], gripper[-1])


def test_a_short_push_stays_where_it_ends() -> None:
    values = {"episode": np.zeros(1), "poses": np.zeros((1, 11, 2, 7)), "push_distance": np.array([0.035])}
    values |= {"push_x": np.array([0.1]), "push_y": np.array([0.0]), "push_angle": np.array([np.pi])}
    found = steps.steps("push", values)
    np.testing.assert_allclose(found["gripper"][0, :6, 0], [0.1, 0.09, 0.08, 0.07, 0.065, 0.065], atol=1e-7)
    np.testing.assert_allclose(found["action"][0, 3:, 0], 0.065, atol=1e-7)


@pytest.mark.parametrize("kind", ["push", "grasp", "images"])
def test_replay_buffers(kind: str, data: Data, tmp_path: pathlib.Path) -> None:
    zarr = pytest.importorskip("zarr")
    sides = load_split(data[kind], kind=kind)
    out = exported(data, kind, tmp_path / "z", "zarr", images="none" if kind == "push" else "before")
    many = 11 if kind == "push" else 1
    for name, wanted in zip(("train", "test"), (sides.learnt.whole(), sides.held_out.whole()), strict=True):
        root = zarr.open_group(out / f"{name}.zarr", mode="r")
        count = len(wanted.fault)
        np.testing.assert_array_equal(root["meta/episode_ends"][:], many * np.arange(1, count + 1))
        np.testing.assert_array_equal(root["data/poses"][:].reshape(wanted.poses.shape), wanted.poses)
        np.testing.assert_array_equal(root["meta/mass"][:], wanted.scene.mass)
        if kind == "push":
            _check_path(root["data/gripper"][11:22], root["data/action"][11:22], wanted[1].push)
        elif kind == "grasp":
            np.testing.assert_array_equal(root["data/action"][:, 3], wanted.grasp.height)
        if kind != "push":
            assert root["data/height"].shape == (count, 224, 224) and root["data/height"][:].max() > 0.02


def test_lerobot(data: Data, pushes: Any, tmp_path: pathlib.Path) -> None:
    """The facts of version 3 of the format that its reader relies on."""
    out = exported(data, "push", tmp_path / "l", "lerobot", images="all")
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["total_frames"] == 264 and info["fps"] == 10
    assert info["splits"] == {"train": "0:20", "test": "20:24"}
    episodes = pq.ParquetDataset(out / "meta" / "episodes").read().sort_by("episode_index").to_pylist()
    assert [one["episode_index"] for one in episodes] == list(range(24))
    last = episodes[-1]
    place = {key: last[f"data/{key}"] for key in ("chunk_index", "file_index")}
    path = out / info["data_path"].format(**place)
    assert pq.ParquetFile(path).num_row_groups == 4, "a row group for each episode"
    frames = pq.read_table(path).slice(33, 11).to_pydict()
    assert frames["index"] == list(range(last["dataset_from_index"], last["dataset_to_index"]))
    assert set(frames) == set(info["features"])
    poses = np.array(frames["observation.environment_state"], np.float32).reshape(11, 3, 7)
    np.testing.assert_array_equal(poses, pushes.poses[23])
    np.testing.assert_allclose(
        last["stats/observation.environment_state/mean"], poses.reshape(11, -1).mean(0), atol=1e-6
    )
    every = pushes.poses.reshape(-1, 21).astype(float)
    statistics = json.loads((out / "meta" / "stats.json").read_text())["observation.environment_state"]
    np.testing.assert_allclose(statistics["std"], every.std(0), atol=1e-6)
    np.testing.assert_allclose(statistics["mean"], every.mean(0), atol=1e-6)
    assert statistics["min"] == every.min(0).tolist() and statistics["count"] == [264]
    assert pq.read_table(out / "meta" / "tasks.parquet").to_pylist() == [{"task_index": 0, "task": "push"}]
    pictures = {name: _decoded(frames[f"observation.images.{name}"]) for name in ("color", "height", "label")}
    seen = render.observe(pushes.scene[23:], pushes.poses[23:, 4])
    np.testing.assert_allclose(pictures["color"][4] / 255, seen.color[0], atol=0.51 / 255)
    np.testing.assert_allclose(pictures["height"][4] / 1000, np.repeat(seen.height[0][..., None], 3, -1), atol=0.00051)
    np.testing.assert_array_equal(pictures["label"][4, ..., 0], seen.label[0] + 1)
    red = pictures["color"][..., 0] / 255
    told = {name: last[f"stats/observation.images.color/{name}"][0][0][0] for name in ("min", "max", "mean", "std")}
    assert told == pytest.approx({"min": red.min(), "max": red.max(), "mean": red.mean(), "std": red.std()})


def _decoded(pictures: list[dict[str, bytes]]) -> np.ndarray:
    return np.stack(
        [cv2.imdecode(np.frombuffer(one["bytes"], np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for one in pictures]
    )


@pytest.mark.parametrize("images", ["none", "all"])
def test_lerobot_doctor_finds_nothing(images: str, data: Data, tmp_path: pathlib.Path) -> None:
    doctor = shutil.which("lerobot-doctor", path=str(pathlib.Path(sys.executable).parent))
    if doctor is None:
        pytest.skip("no lerobot-doctor here")
    out = exported(data, "push", tmp_path / "l", "lerobot", images=images)
    done = subprocess.run([doctor, "check", str(out)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
