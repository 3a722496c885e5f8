"""Errors of predicted masks after a push: which objects and which simulations count."""

from __future__ import annotations

import pathlib
import types
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval.clearing import sweep_merging, sweeping
from dipn_jax.eval.workers.shares import WHOLE, Share

from dipn_jax import structs
from dipn_jax.planning import predictors
from dipn_jax.sight import render
from dipn_jax.structs import ABSENT, Array, Fault, Push, Rollout, Scene, SettledScene, Trajectory
from dipn_jax.world import clutter, scenes

SIZES = (0.05, 0.02, 0.04, 0.04, 0.04)
"""Metres: the sides of five cubes, of which the second is inside the first and the third is absent."""
PLACES = ((-0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.1, 0.0), (0.1, 0.1))
SHIFT = 0.02
"""Metres along x by which objects are moved: ten pixels."""
DISTANCES = (0.05, 0.1)
"""Metres of the pushes."""
MOVED_ERROR = 1 - (20 - 10) / (20 + 10)
"""1 - IoU of a cube of 20 x 20 pixels that is predicted to stay and was moved by ten."""


def _cubes() -> tuple[Scene, np.ndarray]:
    """Return two tables of five cubes each: a large one hides a small one, and one is absent."""
    shape, size = np.array([0, 0, ABSENT, 0, 0], np.int32), np.repeat(np.array(SIZES, np.float32)[:, None], 3, 1)
    ones = np.ones(5, np.float32)
    scene = Scene(shape, size, np.ones((5, 3), np.float32), 0.1 * ones, 0.5 * ones)
    poses = np.zeros((5, 7), np.float32)
    poses[:, :2], poses[:, 2], poses[:, 3] = PLACES, size[:, 0] / 2, 1
    poses[2, :2] = 1.0  # absent objects are far away
    return structs.stack([scene, scene]), np.stack([poses, poses])


def _errors(after: np.ndarray) -> list[np.ndarray]:
    """Return what `_errors` says of the two tables where nothing is predicted to move."""
    scene, poses = _cubes()
    rows = np.arange(16) % 2
    seen = structs.take(render.observe(scene, poses), rows)
    pushes = Push(np.zeros((16, 2), np.float32), np.zeros(16, np.float32), np.full(16, 0.1, np.float32))
    args = (seen, pushes, structs.take(scene, rows), poses[rows], after[rows])
    found = sweeping._errors(*args, predictor=predictors.static_predictor)
    return [np.asarray(each)[:2] for each in found]


def test_objects_that_are_not_in_sight_do_not_count() -> None:
    after = _cubes()[1]
    after[1, [0, 1, 3], 0] += SHIFT
    error, visible, moved = _errors(after)
    assert visible.tolist() == [[True, False, False, True, True]] * 2
    assert moved.tolist() == [[False] * 5, [True, False, False, True, False]]
    np.testing.assert_allclose(error[0], 0, atol=1e-6)
    np.testing.assert_allclose(error[1, 3:], [MOVED_ERROR, 0], atol=1e-6)


class Shifts:
    """An engine that moves the fourth object along x, and on tables where friction is 1, a fault, the fifth too."""

    name, batch = "shifts", 8

    def __init__(self, fault: int) -> None:
        self.fault = fault

    def simulate(self, scene: Scene, poses: Array, _: Trajectory, samples: Array, **__: Any) -> Rollout:
        """Return the poses before and, in all later samples, after the push."""
        out = np.repeat(np.asarray(poses)[:, None], len(samples), 1)
        wrong = np.asarray(scene.friction)[:, 0] == 1
        out[:, 1:, 3, 0] += SHIFT
        out[wrong, 1:, 4, 0] += SHIFT
        fault = np.where(wrong, self.fault, 0).astype(np.int32)
        return Rollout(out, np.zeros((*out.shape[:2], 5), np.float32), fault)


def _measured(fault: int, monkeypatch: pytest.MonkeyPatch, share: Share = WHOLE) -> dict[str, np.ndarray]:
    scene, poses = structs.take(_cubes(), np.array([0, 1, 0]))
    friction = np.repeat(np.array([0.5, 1, 0.5], np.float32)[:, None], 5, 1)
    items = SettledScene(scene.replace(friction=friction), poses, np.zeros(3, np.int32))
    monkeypatch.setattr(clutter, "settled_scenes", lambda *_: items)
    return sweeping.measured(
        predictors.static_predictor,
        Shifts(fault),  # type: ignore[arg-type]
        scenes.fixed_count(5),
        DISTANCES,
        scenes=3,
        seed=0,
        longest=0.1,
        share=share,
    )


def _sweep(fault: int, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    return sweeping.error_rates(_measured(fault, monkeypatch), [sweeping.name(each) for each in DISTANCES])


def test_a_simulation_that_went_wrong_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    without, every = _sweep(Fault.SPEED, monkeypatch), _sweep(Fault.OUTSIDE, monkeypatch)
    for at in ("sweep/0.05/push_error", "sweep/0.1/push_error"):
        assert without[f"{at}/moved"] == pytest.approx(MOVED_ERROR)
        assert without[f"{at}/all"] == pytest.approx(MOVED_ERROR / 3)
        assert every[f"{at}/all"] == pytest.approx(MOVED_ERROR * 4 / 9)


def test_workers_that_share_the_scenes_measure_what_one_does(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where no push is feasible on any scene of one of them."""
    look = sweeping._look
    monkeypatch.setattr(sweeping, "_look", lambda *given: (*look(*given)[:2], given[1].friction[:, 0] == 0.5))
    whole = _measured(Fault.SPEED, monkeypatch)
    assert whole["scene"].tolist() == [0, 2]
    parts = []
    for shard in range(3):
        found = _measured(Fault.SPEED, monkeypatch, Share(shard, 3))
        sweep_merging.save(tmp_path / str(shard), [], found)
        parts.append(types.SimpleNamespace(folder=tmp_path / str(shard), path=(tmp_path / str(shard)).joinpath))
    pooled = sweep_merging._pooled(parts[::-1], len(DISTANCES))  # type: ignore[arg-type]
    for name, values in whole.items():
        np.testing.assert_array_equal(pooled[name], values)
