import json
import pathlib
from typing import Any

import jax
import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.world import cases, scenes, shapes

CONFIG = scenes.fixed_count(5)


def test_the_key_decides_the_scene() -> None:
    a, b = (scenes.random_scene(jax.random.key(3), config=CONFIG) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, a, b)
    c = scenes.random_scene(jax.random.key(4), config=CONFIG)
    assert not np.array_equal(a[0].size, c[0].size)


def test_nothing_overlaps_in_mid_air() -> None:
    scene, poses = scenes.random_scene(jax.random.key(0), config=CONFIG)
    radius = np.asarray(shapes.radius(scene.shape, scene.size))
    gap = np.linalg.norm(np.asarray(poses)[:, None, :3] - np.asarray(poses)[None, :, :3], axis=-1)
    assert (gap + np.eye(5) > radius[:, None] + radius[None]).all()
    assert (np.asarray(poses)[:, 2] > radius).all()


def test_counts_follow_the_config() -> None:
    config = scenes.SceneConfig(slots=5, counts=(0.0, 1.0))
    scene, _ = scenes.random_scene(jax.random.key(0), config=config)
    assert (np.asarray(scene.shape) >= 0).tolist() == [True, True, False, False, False]


def test_hard_cases_load_as_placed() -> None:
    names, scene, poses = cases.load_cases(cases.hard_cases_path())
    assert len(names) == 10 and scene.shape.shape == (10, 6)
    raw = json.loads(cases.hard_cases_path().read_text())["cases"][0]["objects"][0]
    np.testing.assert_allclose(poses[0, 0, :2], raw["position_m"], atol=1e-6)
    assert ((scene.shape >= 0).sum(-1) >= 3).all()


def test_removed_objects_are_absent_and_parked() -> None:
    _, scene, poses = cases.load_cases(cases.hard_cases_path())
    gone = np.zeros(6, bool)
    gone[1] = True
    after, moved = scenes.remove(jax.tree.map(lambda leaf: leaf[0], scene), poses[0], gone)
    assert after.shape[1] == -1 and np.abs(moved[1, :2]).max() > 1
    np.testing.assert_allclose(moved[0], poses[0, 0], atol=1e-7)


def _file(folder: pathlib.Path, **changes: Any) -> pathlib.Path:
    entry = {"shape": "cuboid", "size_mm": [50, 50, 50], "position_m": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    path = folder / "cases.json"
    path.write_text(json.dumps({"cases": [{"name": "a", "objects": [entry | changes]}]}))
    return path


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"shape": "sphere"}, "unknown shape 'sphere'"),
        ({"size_mm": [50, 50]}, "size_mm"),
        ({"size_mm": [500, 50, 50]}, "diagonal"),
        ({"position_m": [1, 0]}, "out of range"),
        ({"quaternion_wxyz": [0, 0, 0, 0]}, "out of range"),
        ({"position_m": "left"}, "position_m"),
        ({"height_m": "x"}, "height_m|could not convert"),
        ({"height_m": float("nan")}, "NaN is not a finite number"),
        ({"position_m": [1e300, 0]}, "number above 1e"),
        ({"position_m": [10**400, 0]}, "position_m"),
        ({"size_mm": ["50", "50", "50"]}, r"size_mm\[0\] is 50, want a finite number"),
        ({"shape": ["cuboid"]}, "unknown shape 'a list of 1'"),
        ({"color_rgb": [-9999, 0, 0]}, "color_rgb"),
        ({"hieght_m": 0.1}, "unknown entry hieght_m, none of shape, size_mm"),
    ],
)
def test_a_wrong_case_file_is_named(tmp_path: pathlib.Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        cases.load_cases(_file(tmp_path, **changes))


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"cases": []}', '{"cases": [{"name": "x"}]}', '{"cases": 3}', '{"cases": [1]}', '{"cases": {"a": 1}}'],
)
def test_a_file_that_is_no_case_file_is_named(tmp_path: pathlib.Path, text: str) -> None:
    path = tmp_path / "cases.json"
    path.write_text(text)
    with pytest.raises(UserError, match="case file"):
        cases.load_cases(path)


@pytest.mark.parametrize("text", ["0", "31", "7:1", "many", "1:x", "-3"])
def test_a_wrong_number_of_objects_is_named(text: str) -> None:
    with pytest.raises(UserError, match="--objects"):
        scenes.parse_objects(text)


def test_a_config_that_contradicts_itself_is_named() -> None:
    with pytest.raises(UserError, match="counts"):
        scenes.SceneConfig(slots=2, counts=(0.5, 0.3, 0.2))
    with pytest.raises(UserError, match="not in the catalogue"):
        scenes.Ranges(items=("banana",))
    with pytest.raises(UserError, match="--items cube cube: want none twice"):
        scenes.Ranges(items=("cube", "cube"))


def test_ranges_out_of_bounds_are_named_as_options() -> None:
    for change in ({"scale": (1.0, 0.9)}, {"density": (0.001, 500.0)}, {"friction": (0.1, float("nan"))}):
        with pytest.raises(UserError, match=f"--{next(iter(change))}"):
            scenes.Ranges(**change)  # type: ignore[arg-type]


def test_sizes_stay_within_bounds_whatever_the_scale() -> None:
    config = scenes.fixed_count(10, ranges=scenes.Ranges(scale=(0.5, 1.2)))
    size = np.asarray(
        jax.vmap(lambda k: scenes.random_scene(k, config=config)[0].size)(jax.random.split(jax.random.key(0), 20))
    )
    assert size.min() >= scenes.MIN_SIDE - 1e-7
    assert np.linalg.norm(size, axis=-1).max() <= shapes.MAX_DIAGONAL + 1e-6


def test_a_card_that_the_gripper_cannot_reach_is_refused_as_it_lies(tmp_path: pathlib.Path) -> None:
    card: dict[str, Any] = {"size_mm": [85, 54, 5]}
    for low in ({}, {"size_mm": [85, 54, 19]}, {"height_m": 0.01}, {"height_m": 0.06}):
        with pytest.raises(UserError, match=r"case a, object 0: is \d+ mm high as it lies, below the gripper's reach"):
            cases.load_cases(_file(tmp_path, **card | low))
    for reached in ({"quaternion_wxyz": [1, 1, 0, 0]}, {"size_mm": [85, 54, 25]}):
        cases.load_cases(_file(tmp_path, **card | reached))
    path = _file(tmp_path, **card | {"height_m": 0.06})
    on_block = json.loads(path.read_text())
    on_block["cases"][0]["objects"].append({**on_block["cases"][0]["objects"][0], "size_mm": [50, 50, 50]})
    del on_block["cases"][0]["objects"][1]["height_m"]
    path.write_text(json.dumps(on_block))
    cases.load_cases(path)
