"""The figures of a correct world on few scenes, and the page that shows them."""

import json
import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.datagen import check, episodes, isolated, world

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.storage import owner
from dipn_jax.system import files
from dipn_jax.world import shapes

DOCS = pathlib.Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def trial(settled: Any) -> world.Trial:
    keys = jax.random.split(jax.random.key(0), len(settled.fault))
    pushes, _ = episodes.aim_pushes(keys, settled.scene, settled.poses, actions=1)
    pushes = jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], pushes)
    return world.Trial(settled, pushes, episodes.aim_grasps(keys, settled.scene, settled.poses, actions=2))


def test_an_engine_agrees_with_itself_and_a_turn_is_measured(engine: Any, trial: world.Trial) -> None:
    counted, poses = world.pushes(engine, trial)
    assert counted["push/moved_objects"] > 2 and 0 <= counted["push/tipped_of_moved"] < 1
    held = world.held_by(engine, trial)
    assert held.shape == (6, 2, 5) and held.any()
    found = world.agreement("native", engine, trial, poses, held)
    assert found["agreement/native/5cm/p90_mm"] == 0 and found["agreement/native/grasp"] == 1
    assert found["agreement/native/grasps"] == 12 and found["agreement/native/grasps_that_held"] == held.any(-1).sum()
    held[0, 1] ^= True
    assert world.agreement("native", engine, trial, poses, held)["agreement/native/grasp"] == 11 / 12
    quarter = np.asarray(geometry.transform_poses(poses.reshape(-1, 7), np.pi / 2, np.zeros(2))).reshape(poses.shape)
    turned = world.agreement("native", engine, trial, quarter, np.zeros((6, 2, 5), bool))
    assert abs(turned["agreement/native/10cm/p50_deg"] - 90) < 0.2


def test_a_short_push_ends_near_the_same_centimetre_of_a_longer_one(engine: Any, trial: world.Trial) -> None:
    _, poses = world.pushes(engine, trial)
    found = world.sweep(engine, trial, poses)
    assert 0 < found["sweep/5cm/p50_mm"] < 2


def test_every_item_stays_on_every_face_that_it_can_stand_on(engine: Any) -> None:
    counts = {}
    for item in shapes.CATALOGUE:
        scene, poses = isolated.standing(np.random.default_rng(0), item)
        counts[item.name] = len(poses)
        for i in range(len(poses)):  # on a face, not on an edge
            parts = isolated._corners(int(scene.shape[i, 0]), scene.size[i, 0], poses[i, 0])
            heights = np.concatenate(parts)[:, 2]
            assert abs(heights.min() - 0.002) < 1e-5 and (heights < heights.min() + 1e-5).sum() >= 3
    assert [counts[name] for name in ("cube", "cylinder", "concave", "triangle")] == [6, 14, 6, 5]
    found = world.rests("native", engine, 0)
    assert found["rest/native/tries"] == sum(counts.values())
    assert found["rest/native/at_rest"] == found["rest/native/as_put"] == 1 and found["rest/native/turn_max_deg"] < 1


def test_an_unknown_engine_is_named() -> None:
    with pytest.raises(UserError, match="bullet: want some of native_awake"):
        check.CheckConfig(("bullet",), 8, 4, 10, 0)


def test_a_folder_that_other_sources_began_is_refused(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = check.CheckConfig((), 8, 4, 10, 0)
    monkeypatch.setattr(check, "_sections", lambda *_: {})
    check.run(tmp_path, config)
    check.run(tmp_path, config)
    monkeypatch.setattr(files, "code_digest", lambda *_: "other")
    with pytest.raises(UserError, match="begun with code="):
        check.run(tmp_path, config)


def test_the_page_in_docs_shows_the_figures_in_docs() -> None:
    metrics = json.loads((DOCS / "world.json").read_text())
    blocks = check.page(metrics).strip().split("\n\n")
    assert len(blocks) > 10
    page = (DOCS / "world.md").read_text()
    assert [block for block in blocks if f"\n\n{block}\n" not in page] == []
    assert min(v for k, v in metrics.items() if k.startswith("grasp_isolated/")) >= 0.98


def test_a_second_measurement_into_a_folder_is_told_who_has_it(tmp_path: pathlib.Path) -> None:
    with owner.owned(tmp_path / "out"), pytest.raises(UserError, match="out: in use by host "):
        check.run(tmp_path / "out", check.CheckConfig((), scenes=1, few=1, tries=1, seed=0))
