"""Grasps tried on random tables, and their rates where outcomes are known: an engine with one rule, three peaks."""

from __future__ import annotations

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.eval.clearing import instances, lockstep, on_tables
from dipn_jax.eval.clearing.camera import Camera
from dipn_jax.eval.clearing.instances import Instance
from dipn_jax.eval.grasping import rates, success

from dipn_jax import geometry, structs
from dipn_jax.planning import planner, scorers
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import ABSENT, Array, Fault, Grasp, Observation, Rollout, Scene, SettledScene, Trajectory
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import clutter, scenes

CONFIG = scenes.fixed_count(3, spread=0.2)
PEAKS = {"first": (60, 60), "second": (60, 150), "third": (150, 60), "none": (150, 150)}
"""Pixels (row, col): the best grasp, the two next best, and one that is not among these."""
FAULTY = 2.0
"""Friction of an object whose simulation goes wrong."""
HEAVY = 5.0
"""Mass of an object that is not lifted."""


def peaks(images: jax.Array) -> jax.Array:
    """Score grasps: a Scorer of the same three peaks on every image."""
    scores = jnp.zeros((images.shape[0], 16, *images.shape[1:3]))
    for name, score in (("first", 0.9), ("second", 0.8), ("third", 0.7)):
        scores = scores.at[:, 0, *PEAKS[name]].set(score)
    return scores


class Lifts:
    """An engine in which a grasp lifts a light object if it is centred on it, and some simulations go wrong."""

    name, batch = "lifts", 4

    def __init__(self, reach: float = 0.005) -> None:
        self.reach = reach

    def simulate(self, scene: Scene, poses: Array, paths: Trajectory, samples: Array, **_: Any) -> Rollout:
        """Return poses at the start and at the end of the lift."""
        out = np.repeat(np.asarray(poses)[:, None], len(samples), 1)
        away = np.linalg.norm(out[:, 0, :, :2] - np.asarray(paths.target)[:, 2, None, :2], axis=-1)
        out[:, -1, :, 2] += np.where((away < self.reach) & (np.asarray(scene.mass) < HEAVY), GRIPPER.lift, 0)
        fault = np.where((np.asarray(scene.friction) == FAULTY).any(-1), Fault.NON_FINITE, Fault.GRIPPER_SHORT)
        return Rollout(out, np.zeros((*out.shape[:2], 5), np.float32), fault.astype(np.int32))


def _table(did: list[str], place: str, *, friction: float = 0.5, mass: float = 0.1) -> Instance:
    """Return a table that ended: a cube stood at `place` of PEAKS before every action, and then it was removed."""
    size, color = np.full((1, 3), 0.04, np.float32), np.ones((1, 3), np.float32)
    one = np.ones(1, np.float32)
    scene = Scene(np.full(1, ABSENT, np.int32), size, color, mass * one, friction * one)
    center = geometry.pixels_to_metres(jnp.array(PEAKS[place][::-1]))
    poses = np.array([[*center, 0.02, 1, 0, 0, 0]], np.float32)
    grasp = np.array([0, *PEAKS["first"]], np.int32)
    known = {"shape": np.zeros(1, np.int32), "poses": poses, "missed": planner.NONE_MISSED, "grasp": grasp}
    film = [known | {"values": np.array([0.9, 0, 0])} for _ in did]
    return Instance("x", scene, poses + 1, 1, did=did, film=film)


def _others(tables: list[Instance], count: int) -> dict[str, float]:
    """Return what is said of the grasps that are tried after a miss."""
    found = success._other_grasps(peaks, Lifts(), tables, count)  # type: ignore[arg-type]
    attempts = np.zeros(sum(len(table.did) for table in tables), int)
    return rates._other_rates(found | {"table": attempts}, count)


def test_the_ceiling_counts_the_misses_that_a_next_best_grasp_would_have_held() -> None:
    tables = [
        _table(["grasp missed", "grasp held", "grasp held"], "second"),
        _table(["grasp missed", "grasp missed"], "third"),
        _table(["grasp missed", "grasp missed"], "none"),
        _table(["grasp missed"], "first"),  # the grasp that missed is not tried again
        _table(["grasp missed"], "second", friction=FAULTY),
        _table(["grasp held"], "second"),
    ]
    found = _others(tables, 2)
    assert (found["other_grasps/missed"], found["other_grasps/tried_each"]) == (7, 2)
    assert found["other_grasps/one_holds"] == pytest.approx(3 / 7)
    assert found["other_grasps/ceiling"] == pytest.approx(1 - 4 / 10)
    one = _others(tables, 1)
    assert one["other_grasps/one_holds"] == pytest.approx(1 / 7)
    assert one["other_grasps/ceiling"] == pytest.approx(1 - 6 / 10)


def test_other_grasps_are_ranked_with_the_misses_that_the_policy_knew() -> None:
    table = _table(["grasp missed"], "third")
    assert _others([table], 1)["other_grasps/one_holds"] == 0
    row, col = PEAKS["second"]  # 0.8 is halved: the third is now the next best
    table.film[0]["missed"] = np.array([[0, row, col]], np.int32)
    assert _others([table], 1)["other_grasps/one_holds"] == 1


def test_the_grasp_that_missed_is_left_out_whatever_its_rank() -> None:
    table = _table(["grasp missed"], "first")
    assert _others([table], 1)["other_grasps/one_holds"] == 0
    table.film[0]["grasp"] = np.array([0, *PEAKS["second"]], np.int32)
    assert _others([table], 1)["other_grasps/one_holds"] == 1


def test_without_a_miss_there_is_no_ceiling() -> None:
    found = _others([_table(["grasp held"], "second")], 3)
    assert found == {"other_grasps/missed": 0, "other_grasps/tried_each": 3}


def test_a_random_grasp_that_went_wrong_does_not_count() -> None:
    tables = [_table([], "first", mass=mass, friction=f) for mass, f in ((0.1, 0.5), (HEAVY, 0.5), (HEAVY, FAULTY))]
    for table in tables:
        table.scene, table.poses = table.scene.replace(shape=np.zeros(1, np.int32)), table.poses - 1
    seen = []

    class Noisy(Camera):
        def look(self, *args: Any) -> Observation:
            seen.append(super().look(*args))
            return seen[-1]

    camera = Noisy(height_noise=0.001)
    keys = success._random_keys(0, 3)
    tried = success._random_foreground(peaks, Lifts(reach=1), tables, keys, camera)  # type: ignore[arg-type]
    found = rates._random_rates(tried)
    assert np.std(seen[0].height[:, :40, 200:]) == pytest.approx(0.001, rel=0.1), "what the camera sees is grasped"
    assert found["grasp_success/random_foreground"] == pytest.approx(1 / 2)
    assert found["random/reliability/0/count"] == 2 and found["random/expected_calibration_error"] == pytest.approx(0.5)


def test_labels_are_held_against_the_grasps_that_went_well(monkeypatch: pytest.MonkeyPatch) -> None:
    # two grasps a table: labels, mass, friction, and how far the second is off the object
    rows = [((1, 0), 0.1, 0.5, 1.0), ((1, 1), 0.1, 0.5, 1.0), ((1, 0), HEAVY, 0.5, 0.0), ((0, 1), 0.1, 0.5, 0.0)]
    rows.append(((1, 1), HEAVY, FAULTY, 0.0))
    tables = [_table([], "none", mass=mass, friction=friction) for _, mass, friction, _ in rows]
    scene = structs.stack([table.scene.replace(shape=np.zeros(1, np.int32)) for table in tables])
    items = SettledScene(scene, np.stack([table.poses - 1 for table in tables]), np.zeros(5, np.int32))
    labels = np.resize(np.array([row[0] for row in rows], np.float32), (16, 2))
    off = np.resize(np.array([[0, row[3]] for row in rows], np.float32), (16, 2))

    def labelled(keys: Array, scene: Scene, poses: Array, *, count: int) -> tuple[Grasp, Array]:
        centers = np.asarray(poses)[:, 0, None, :2] + off[..., None]
        return Grasp(centers, np.zeros((16, count), np.float32), np.zeros((16, count), np.float32)), labels

    monkeypatch.setattr(success, "_labelled", labelled)
    monkeypatch.setattr(clutter, "settled_scenes", lambda *_: items)
    found = rates.label_rates(success.labels_tried(Lifts(), CONFIG, scenes=5, seed=0, each=2))  # type: ignore[arg-type]
    wanted = {"grasps": 8, "agree": 5 / 8, "positive_holds": 3 / 5, "negative_fails": 2 / 3, "positive": 5 / 8}
    assert found == pytest.approx(wanted)


def test_the_rates_are_of_all_grasps_and_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = [
        _table(["grasp missed", "grasp missed", "grasp held"], "none"),
        _table(["grasp held"], "none"),
        _table(["grasp missed", "grasp held"], "none"),
        _table(["grasp held", "grasp held", "grasp missed"], "none"),
    ]
    for table, end in zip(tables, ("cleared", "cleared", "pushed out", "cleared"), strict=True):
        table.ended = end
    monkeypatch.setattr(instances, "random_instances", lambda *_, **__: tables)
    monkeypatch.setattr(lockstep, "clear", lambda *_, **__: tables)
    random = {"random_usable": np.ones(4, bool), "random_success": np.ones(4, bool), "random_score": np.ones(4)}
    monkeypatch.setattr(success, "_random_foreground", lambda *_: random)
    monkeypatch.setattr(on_tables, "in_lockstep", lambda policy, camera: policy)
    one, lifts = scenes.fixed_count(1), Lifts()
    tried = success.tried(peaks, lifts, one, None, scenes=4, seed=0, others=0)  # type: ignore[arg-type]
    found = rates.rates(*tried, others=0)
    assert found["grasp_success/gn"] == pytest.approx(5 / 9)
    assert found["grasp_success/gn_first"] == pytest.approx(2 / 4)
    assert (found["attempts"], found["scenes"]) == (9, 4)
    assert (found["table/ended_cleared"], found["table/ended_pushed_out"]) == (3, 1)
    assert found["reliability/9/count"] == 9 and found["reliability/9/success"] == pytest.approx(5 / 9)


def test_calibration_weighs_the_bins_by_their_counts() -> None:
    scores, held = np.array([0.0, 0.05, 0.1, 0.62, 0.68, 0.65, 1.0, 0.94]), np.array([0, 1, 0, 1, 0, 1, 1, 0])
    found = rates.calibration(scores, held)
    bins = {0: (2, 0.025, 1 / 2), 1: (1, 0.1, 0), 6: (3, 0.65, 2 / 3), 9: (2, 0.97, 1 / 2)}
    for b, wanted in bins.items():
        assert tuple(found[f"reliability/{b}/{key}"] for key in ("count", "score", "success")) == pytest.approx(wanted)
    assert len(found) == 1 + 3 * len(bins)
    error = sum(count * abs(came - said) for count, said, came in bins.values()) / 8
    assert found["expected_calibration_error"] == pytest.approx(error)


def test_calibration_error_of_known_scores() -> None:
    for held, error in ((1, 0.05), (0, 0.95)):
        found = rates.calibration(np.full(10, 0.95), np.full(10, held))
        assert found["expected_calibration_error"] == pytest.approx(error)
        assert found["reliability/9/count"] == 10 and found["reliability/9/success"] == held


@pytest.mark.slow
def test_grasp_evaluation_writes_what_it_promises(
    engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    scorer = scorers.load_scorer(runs["grasp"])
    found, tables = success.tried(scorer, engine, CONFIG, Partial(tmp_path, {}), scenes=3, seed=3, others=2)
    values = rates.rates(found, tables, others=2)
    assert values["attempts"] == sum(table.grasps for table in tables) >= 3 and values["scenes"] == 3
    assert sum(value for key, value in values.items() if key.startswith("table/")) == 3
    held, saved = found["held"].sum(), found["missed_held"].sum()
    assert values["other_grasps/missed"] == values["attempts"] - held > 0
    assert values["other_grasps/ceiling"] == pytest.approx((held + saved) / values["attempts"])
    for name in ("gn", "random_foreground"):
        assert 0 <= values[f"grasp_success/{name}_low"] <= values[f"grasp_success/{name}"] <= 1


@pytest.mark.slow
def test_labels_of_pretraining_mostly_agree_with_physics(engine: Any) -> None:
    found = rates.label_rates(success.labels_tried(engine, scenes.fixed_count(1), scenes=16, seed=0))
    assert found["grasps"] > 48 and 0.1 < found["positive"] < 0.9
    assert found["agree"] > 0.7
