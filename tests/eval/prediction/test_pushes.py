"""What counts as the truth of a push, and what the engine itself would predict, with an engine of a known answer."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.eval.prediction import push_errors, pushes

from dipn_jax import structs
from dipn_jax.sight import segment
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import ABSENT, Array, Fault, Rollout, Scene, SettledScene, Trajectory
from dipn_jax.world import clutter, scenes, shapes

CONFIG = scenes.fixed_count(5)
SLIDE = np.array([0.01, 0.02], np.float32)
"""Metres that an object slides in each centimetre of a push: along x times its friction, along y times its mass."""


class Slides:
    """An engine under which every object slides, and in which scenes whose first object is black are a fault."""

    name, batch = "slides", 8

    def __init__(self, slide: Array = SLIDE, fault: int = 0) -> None:
        self.slide, self.fault = slide, fault

    def simulate(self, scene: Scene, poses: Array, _: Trajectory, samples: Array, **__: Any) -> Rollout:
        """Return the poses after 0, 1, ... centimetres."""
        out = np.repeat(np.asarray(poses)[:, None], len(samples), 1)
        factor = np.stack([scene.friction, scene.mass], -1)[:, None]
        out[..., :2] += np.arange(len(samples))[None, :, None, None] * self.slide * factor
        fault = np.where(_black(scene), self.fault, 0).astype(np.int32)
        return Rollout(out, np.zeros((*out.shape[:2], 5), np.float32), fault)


def _black(scene: Scene) -> np.ndarray:
    return (np.asarray(scene.color)[:, 0] == 0).all(-1)


@pytest.fixture
def items(settled: SettledScene, monkeypatch: pytest.MonkeyPatch) -> SettledScene:
    """Evaluate on scenes of which every second has a black object, and whose masses and frictions are unusual."""
    color = settled.scene.color.copy()
    color[::2, 0] = 0
    mass, friction = 3 * settled.scene.mass, settled.scene.friction + 1
    given = settled.replace(scene=settled.scene.replace(color=color, mass=mass, friction=friction))
    monkeypatch.setattr(clutter, "settled_scenes", lambda *args: structs.take(given, slice(0, args[3])))
    return given


def _execute(engine: Slides, *, physics: bool = False) -> pushes.Executed:
    return pushes.execute(jax.random.key(0), engine, CONFIG, 6, physics=physics)  # type: ignore[arg-type]


def test_the_floor_guesses_mass_and_friction(items: SettledScene) -> None:
    executed = _execute(Slides(), physics=True)
    scene, before = executed.items.scene, executed.items.poses
    assert executed.rolled is not None and len(executed) >= 4
    for k, centimetres in enumerate(pushes.DISTANCES):
        true = centimetres * SLIDE * np.stack([scene.friction, scene.mass], -1)
        np.testing.assert_allclose((executed.truth[:, 1 + k] - before)[..., :2], true, atol=1e-6)
        mass = 500 * shapes.volume(scene.shape, scene.size)
        guess = centimetres * SLIDE * np.stack([np.full(mass.shape, 0.35), mass], -1)
        np.testing.assert_allclose((executed.rolled[:, k] - before)[..., :2], guess, atol=1e-6)
    rows: push_errors.Rows = {}
    push_errors.measure(rows, executed, {}, executed.seen())
    off = np.linalg.norm(guess - true, axis=-1) * 1000
    assert off.min() > 50
    np.testing.assert_allclose(rows["physics/push_position_mm"][0][:, -1], off, rtol=1e-3)


def test_a_right_guess_has_no_error(items: SettledScene, monkeypatch: pytest.MonkeyPatch) -> None:
    guessed = items.replace(scene=scenes.nominal(items.scene))
    monkeypatch.setattr(clutter, "settled_scenes", lambda *_: guessed)
    executed = _execute(Slides(), physics=True)
    rows: push_errors.Rows = {}
    push_errors.measure(rows, executed, {}, executed.seen())
    for measure in ("push_position_mm", "push_angle_deg"):
        np.testing.assert_array_equal(rows[f"physics/{measure}"][0], 0)
    assert rows["moved"][0].any()


def test_a_simulation_that_went_wrong_is_no_truth(items: SettledScene) -> None:
    every = _execute(Slides(), physics=True)
    black = _black(every.items.scene)
    assert 0 < black.sum() < len(every)
    for fault in (Fault.NON_FINITE, Fault.CAPACITY, Fault.SPEED, Fault.PENETRATION):
        kept = _execute(Slides(fault=fault), physics=True)
        jax.tree.map(np.testing.assert_array_equal, vars(kept), {k: v[~black] for k, v in vars(every).items()})
    assert len(_execute(Slides(fault=Fault.OUTSIDE | Fault.UNSETTLED | Fault.TIPPED))) == len(every)


def test_masks_found_in_the_image_are_measured_by_themselves(
    items: SettledScene, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost: list[bool] = []

    def find(height: Array, color: Array, true: np.ndarray, *, slots: int) -> tuple[np.ndarray, np.ndarray]:
        lost.append(bool((true == 0).any()))
        return np.where(true == 0, ABSENT, true), np.ones(slots, bool)

    monkeypatch.setattr(segment, "segment_as", find)
    still = Slides(np.zeros(2, np.float32))
    rows, _ = push_errors.measured(
        {}, still, CONFIG, Partial(tmp_path, {}), scenes=4, seed=0, physics=True, segmented=True
    )
    values = push_errors.summary(rows)
    share = sum(lost) / values["objects"]
    assert 0.1 < share < 0.4 and len(lost) == values["pushes"] == 4
    for name in ("static", "physics"):
        at = f"{name}/10cm/all"
        assert values[f"push_error/{at}"] == values[f"push_error_paper_measure/{at}"] == 0
        assert values[f"push_error_segmented/{at}"] == pytest.approx(share)
        assert values[f"push_error_segmented_paper_measure/{at}"] == pytest.approx(share / 2)


def test_the_summary_counts_what_is_visible_and_what_moved() -> None:
    visible = np.array([[[1, 1, 0]] * 2, [[1, 1, 1]] * 2], bool)
    moved = np.array([[[1, 0, 0]] * 2, [[0, 0, 0], [0, 1, 0]]], bool)
    error = np.array([[[0.1, 0.2, 9.0], [0.3, 0.4, 9.0]], [[0.5, 0.6, 0.7], [0.8, 0.9, 1.0]]])
    keys = ("push_error", "push_error_paper_measure", "push_position_mm", "push_angle_deg")
    rows = {f"a/{key}": error * (i + 1) for i, key in enumerate(keys)}
    found = push_errors.summary({"visible": visible, "moved": moved, **rows})
    assert found["push_error/a/5cm/all"] == pytest.approx((0.1 + 0.2 + 0.5 + 0.6 + 0.7) / 5)
    assert found["push_error_paper_measure/a/10cm/all"] == pytest.approx(2 * (0.3 + 0.4 + 0.8 + 0.9 + 1.0) / 5)
    assert found["push_error/a/5cm/moved"] == pytest.approx(0.1)
    assert found["push_position_mm/a/10cm/moved"] == pytest.approx(3 * (0.3 + 0.9) / 2)
    assert found["push_angle_deg/a/5cm/moved"] == pytest.approx(4 * 0.1)
    assert (found["objects_moved/5cm"], found["objects_moved/10cm"]) == (1, 2)
    assert (found["objects"], found["pushes"]) == (5, 2)
