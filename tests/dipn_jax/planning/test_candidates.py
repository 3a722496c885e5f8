from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import geometry, structs
from dipn_jax.planning import candidates
from dipn_jax.sight import fingers, render
from dipn_jax.structs import ABSENT, Observation
from dipn_jax.workspace import GRIPPER


def _seen(settled: Any, index: int = 0) -> Observation:
    return render.render(structs.take(settled.scene, index), settled.poses[index])


def test_feasible_pushes_start_free_inside_and_aim_at_an_object(settled: Any) -> None:
    seen = _seen(settled)
    pushes, feasible = candidates.sample_pushes(jax.random.key(0), seen, count=16, distance=0.1)
    assert feasible[:4].all() and (np.diff(np.asarray(feasible).astype(int)) <= 0).all(), "feasible ones first"
    pixel = np.asarray(geometry.metres_to_pixels(pushes.start))[feasible]
    assert pixel.min() >= 10 and pixel.max() <= 214
    height, label = np.asarray(seen.height), np.asarray(seen.label)
    for col, row in np.round(pixel).astype(int):
        assert height[row - 4 : row + 5, col - 4 : col + 5].max() < 0.01
    direction = np.stack([np.cos(pushes.angle), np.sin(pushes.angle)], -1)[feasible]
    contact = pixel + 15 * direction
    near = [label[int(r) - 2 : int(r) + 3, int(c) - 2 : int(c) + 3].max() >= 0 for c, r in contact]
    assert all(near), "15 pixels ahead of the start is an object"


def test_the_key_decides_the_pushes(settled: Any) -> None:
    seen = _seen(settled)
    draw = [candidates.sample_pushes(jax.random.key(k), seen, count=16, distance=0.1)[0] for k in (0, 0, 1)]
    np.testing.assert_array_equal(draw[0].start, draw[1].start)
    assert not np.array_equal(draw[0].start, draw[2].start)


def test_an_empty_table_has_no_feasible_push() -> None:
    zero = jnp.zeros((224, 224))
    seen = Observation(zero, jnp.zeros((224, 224, 3)), jnp.full((224, 224), ABSENT), 5)
    _, feasible = candidates.sample_pushes(jax.random.key(0), seen, count=16, distance=0.1)
    assert not feasible.any()


def test_a_push_off_the_table_is_dropped() -> None:
    centers, area = jnp.array([[0.15, 0.0], [0.0, 0.0]]), jnp.array([100.0, 100.0])
    still = jnp.zeros((2, 3))
    assert candidates.stays_inside(centers, area, still)
    out = still.at[0, 0].set(0.03)  # that passes pixel 199, 0.175 m
    assert not candidates.stays_inside(centers, area, out)
    assert candidates.stays_inside(centers, area.at[0].set(0.0), out), "an object out of sight does not count"
    assert candidates.stays_inside(centers.at[0, 0].set(0.2), area, out.at[0, 0].set(-0.01)), "moving inward is fine"


def test_random_grasps_lie_on_objects_at_the_height_below_them(settled: Any) -> None:
    seen = _seen(settled)
    grasps = candidates.random_grasps(jax.random.key(0), seen, count=8)
    pixel = np.round(np.asarray(geometry.metres_to_pixels(grasps.center))).astype(int)
    height = np.asarray(seen.height)[pixel[:, 1], pixel[:, 0]]
    assert (np.asarray(seen.label)[pixel[:, 1], pixel[:, 0]] >= 0).all()
    deepest = np.maximum(height - 0.04, 0.02)
    highest = np.maximum(height - 0.015, deepest + 0.004)
    assert ((grasps.height > deepest - 1e-6) & (grasps.height < highest + 1e-6)).all()
    steps = np.asarray(grasps.angle) / (np.pi / 8)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)


def test_best_grasp_is_the_highest() -> None:
    scores = jnp.zeros((16, 224, 224)).at[5, 17, 200].set(0.9)
    index, score = candidates.best_grasp(scores)
    assert index.tolist() == [5, 17, 200] and np.isclose(score, 0.9)


def test_a_grasp_is_at_the_place_of_its_index() -> None:
    index = np.array([[3, 100, 20], [15, 0, 223]])
    taken = candidates.grasp_at(index, jnp.zeros((224, 224)))
    np.testing.assert_array_equal(candidates.grasp_index(taken), index)


def test_guided_grasps_are_where_the_scores_are_high_and_hard_ones_where_they_are_half() -> None:
    label = jnp.full((224, 224), ABSENT).at[50:150, 50:150].set(0)
    seen = Observation(jnp.where(label == 0, 0.05, 0.0), jnp.zeros((224, 224, 3)), label, 1)
    scores = jnp.full((16, 224, 224), 1e-3).at[5, 60:64, 60:64].set(0.99).at[9, 120:124, 120:124].set(0.5)
    scores = scores.at[2, :40, :40].set(0.999)  # on the table: nothing to grasp

    def rotations(guided: float, unsure: float) -> np.ndarray:
        taken = candidates.sample_grasps(jax.random.key(0), seen, scores, count=16, guided=guided, unsure=unsure)
        return np.asarray(candidates.grasp_index(taken))[:, 0]

    assert (rotations(1.0, 0.0) == 5).mean() > 0.9
    assert (rotations(0.0, 1.0) == 9).mean() > 0.5
    assert len(set(rotations(0.0, 0.0))) > 6, "the others are anywhere"


def test_the_best_grasps_stand_apart() -> None:
    scores = jnp.zeros((16, 64, 64)).at[0, 10, 10].set(0.9).at[1, 10, 12].set(0.8).at[2, 40, 40].set(0.7)
    np.testing.assert_array_equal(candidates.best_grasps(scores, count=2), [[0, 10, 10], [2, 40, 40]])


def test_grasps_like_one_that_missed_have_half_the_score() -> None:
    scores = jnp.full((16, 64, 64), 0.8)
    missed = np.array([[15, 30, 20], [15, 30, 24], [-1, -1, -1]])
    found = np.asarray(candidates.discount_missed(scores, missed))
    for rotation, row, col, share in ((15, 30, 20, 4), (7, 30, 20, 4), (0, 30, 20, 4), (6, 30, 20, 4), (1, 30, 20, 1)):
        assert found[rotation, row, col] == pytest.approx(0.8 / share)
    for row, col, share in ((30, 33, 2), (41, 20, 1), (30, 12, 2), (23, 30, 2)):
        assert found[15, row, col] == pytest.approx(0.8 / share), (row, col)
    np.testing.assert_array_equal(candidates.discount_missed(scores, np.full((2, 3), -1)), scores)


def test_a_push_can_begin_where_the_footprint_is_free(settled: Any) -> None:
    seen = _seen(settled)
    possible = np.asarray(fingers.pushable(seen.height))
    assert possible.shape == (16, 224, 224) and not possible[:, :10].any() and not possible[:, :, 215:].any()
    rng = np.random.default_rng(0)
    index = np.stack([rng.integers(16, size=400), rng.integers(20, 204, 400), rng.integers(20, 204, 400)], -1)
    pushes = jax.vmap(candidates.push_at, in_axes=(0, None))(index, 0.1)
    free = np.asarray(jax.vmap(fingers.footprint_free, in_axes=(None, 0, 0))(seen.height, pushes.start, pushes.angle))
    at = possible[tuple(index.T)]
    assert 0.3 < free.mean() < 0.98
    assert (at == free).mean() > 0.96, "they differ only within a pixel of an object"
    np.testing.assert_array_equal(jax.vmap(candidates.push_index)(pushes), index)


def test_each_candidate_may_have_its_own_distance(settled: Any) -> None:
    distances = np.linspace(0.03, 0.1, 8, dtype=np.float32)
    pushes, _ = candidates.sample_pushes(jax.random.key(0), _seen(settled), count=8, distance=distances)
    np.testing.assert_array_equal(pushes.distance, distances)


def test_the_hand_stops_on_what_a_finger_meets() -> None:
    def tip(object_height: float, neighbour: float, rotation: int = 0) -> float:
        # 50 mm square in the middle; 4 mm beside where the fingers come down to its right, a neighbour
        height = np.zeros((224, 224), np.float32)
        height[100:125, 100:125] = object_height
        height[60:165, 134:160] = neighbour
        return float(candidates.grasp_at(jnp.array([rotation, 112, 112]), jnp.asarray(height)).height)

    assert tip(0.05, 0.0) == pytest.approx(0.02)
    assert tip(0.05, 0.025) == pytest.approx(0.026)
    assert tip(0.05, 0.025, rotation=4) == pytest.approx(0.02)  # closing along the rows it is not met
    assert tip(0.05, 0.06) == pytest.approx(0.035)  # as deep as it must
    assert tip(0.025, 0.025) == pytest.approx(0.024)  # low things: a little short
    assert tip(0.09, 0.04) == pytest.approx(0.05)  # goes by far over it


def test_an_object_at_the_border_is_assumed_to_extend_beyond_it() -> None:
    height = np.zeros((224, 224), np.float32)
    height[100:125, 180:] = 0.03
    across = np.array([[0, 112, 200], [4, 112, 200]])  # a finger outside the map; none
    found = jax.vmap(candidates.grasp_at, in_axes=(0, None))(jnp.asarray(across), jnp.asarray(height)).height
    np.testing.assert_allclose(found, [0.024, 0.02], atol=1e-6)


def test_under_fingers_agrees_with_the_simulated_fingers(settled: Any, rng: np.random.Generator) -> None:

    height = np.asarray(render.render(structs.take(settled.scene, 0), settled.poses[0]).height)
    center = rng.uniform(-0.1, 0.1, (30, 2)).astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi, 30).astype(np.float32)
    found = np.asarray(fingers.under_fingers(jnp.asarray(height), jnp.asarray(center), jnp.asarray(angle)))
    row, col = np.indices(height.shape)
    xy = (np.stack([col, row], -1) - 111.5) * 0.002
    near, far, half = GRIPPER.stroke / 2, GRIPPER.stroke / 2 + GRIPPER.thickness, GRIPPER.pad_width / 2
    for c, a, value in zip(center, angle, found, strict=True):
        u = (xy - c) @ [np.cos(a), np.sin(a)]
        v = (xy - c) @ [-np.sin(a), np.cos(a)]

        def within(margin: float, u: np.ndarray = u, v: np.ndarray = v) -> float:
            hit = (np.abs(u) > near - margin) & (np.abs(u) < far + margin) & (np.abs(v) < half + margin)
            return float(height[hit].max())

        assert within(-0.0005) - 1e-6 <= value <= within(0.003) + 1e-6
