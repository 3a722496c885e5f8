from typing import Any

import cv2
import jax
import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.sight import render, segment
from dipn_jax.structs import ABSENT, Observation

SLOTS = 5


@pytest.fixture(scope="module")
def seen(settled: Any) -> Observation:
    return jax.tree.map(np.asarray, render.observe(settled.scene, settled.poses))


def _ious(found: np.ndarray, true: np.ndarray) -> list[float]:
    matched = segment.match(found, true, slots=SLOTS)
    pairs = [(found == matched[i], true == i) for i in range(SLOTS) if (true == i).sum() >= segment.MIN_REGION_PIXELS]
    return [(a & b).sum() / (a | b).sum() for a, b in pairs]


@pytest.mark.parametrize(("noise", "wanted"), [(0.0, 0.98), (1.0, 0.95)])
def test_masks_are_those_of_the_simulator(noise: float, wanted: float, seen: Observation, rng: Any) -> None:
    ious = []
    for height, color, label in zip(seen.height, seen.color, seen.label, strict=True):
        noisy_height = height + rng.normal(0, noise * 1e-3, height.shape)
        noisy_color = np.clip(color + rng.normal(0, noise * 0.02, color.shape), 0, 1)
        found = segment.segment(noisy_height, noisy_color, slots=SLOTS)
        assert set(np.unique(found)) <= {ABSENT, *range(SLOTS)}
        ious += _ious(found, label)
    assert np.mean(ious) > wanted


def test_distinct_colours_are_opencvs_components(seen: Observation) -> None:
    for height, color, label in zip(seen.height, seen.color, seen.label, strict=True):
        found = segment.segment(height, color, slots=SLOTS)
        for i in range(SLOTS):
            exact = (color == color[label == i][0]).all(-1) if (label == i).any() else np.zeros_like(label, bool)
            count, parts, stats, _ = cv2.connectedComponentsWithStats(exact.astype(np.uint8), connectivity=4)
            if count > 1 and stats[1:, cv2.CC_STAT_AREA].max() >= 100:
                largest = parts == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()
                inside = found[largest]
                assert np.bincount(inside[inside != ABSENT]).max() > 0.95 * largest.sum()


def _boxes(*boxes: tuple[int, int, int, int, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return height and colour of boxes (row, row, col, col, metres, red)."""
    height, color = np.zeros((224, 224), np.float32), np.full((224, 224, 3), 0.2, np.float32)
    for r0, r1, c0, c1, z, red in boxes:
        height[r0:r1, c0:c1] = z
        color[r0:r1, c0:c1] = (red, 0.5, 0.5)
    return height, color


def test_a_part_under_another_object_is_bridged_and_a_gap_is_not() -> None:
    # a low bar under a high one that crosses it; then the same two halves with the table between them
    crossed = segment.segment(*_boxes((100, 120, 60, 140, 0.03, 0.9), (60, 160, 90, 110, 0.06, 0.4)), slots=4)
    assert crossed[110, 70] == crossed[110, 130] != crossed[110, 100]
    apart = segment.segment(*_boxes((100, 120, 60, 90, 0.03, 0.9), (100, 120, 110, 140, 0.03, 0.9)), slots=4)
    assert apart[110, 70] != apart[110, 130] and apart[110, 100] == ABSENT


def test_the_largest_masks_come_first_and_the_rest_is_dropped() -> None:
    image = _boxes((10, 30, 10, 30, 0.05, 0.9), (50, 100, 50, 100, 0.05, 0.4), (150, 160, 150, 160, 0.05, 0.9))
    found = segment.segment(*image, slots=2)
    assert found[75, 75] == 0 and found[20, 20] == 1 and found[155, 155] == ABSENT
    assert (segment.segment(*_boxes(), slots=2) == ABSENT).all()


def test_the_foot_of_a_slope_is_recognized_by_its_colour() -> None:
    height, color = _boxes((100, 120, 100, 140, 0.05, 0.9))
    height[100:120, 100:140] = np.linspace(0, 0.05, 40)
    assert (segment.segment(height, color, slots=1)[102:118, 102:138] == 0).all()


def test_match_takes_the_best_pair_first() -> None:
    true = np.array([[0, 0, 0, 1, 1, ABSENT]])
    found = np.array([[2, 2, 1, 1, 1, 0]])
    assert segment.match(found, true, slots=3).tolist() == [2, 1, ABSENT]


def test_found_masks_take_the_numbers_of_their_objects() -> None:
    height, color = _boxes((10, 30, 10, 30, 0.05, 0.9), (50, 100, 50, 100, 0.05, 0.4), (150, 180, 150, 180, 0.05, 0.9))
    true = np.full((224, 224), ABSENT)
    true[10:30, 10:30], true[50:100, 50:100] = 2, 0  # the third box belongs to nothing
    label, known = segment.segment_as(height, color, true, slots=3)
    assert known.tolist() == [True, False, True]
    assert (label[15, 15], label[75, 75], label[165, 165]) == (2, 0, 1)


def test_an_array_that_is_not_an_image_is_refused() -> None:
    height, color = _boxes()
    with pytest.raises(UserError, match="crop it to the workspace"):
        segment.segment(height[1:], color, slots=2)
    height[3, 3] = np.nan
    with pytest.raises(UserError, match="not finite"):
        segment.segment(height, color, slots=2)
