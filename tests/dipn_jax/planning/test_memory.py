"""Grasps that missed are remembered as long as the rendered table looks the same around them."""

import cv2
import numpy as np
import pytest

from dipn_jax import geometry
from dipn_jax.planning import memory
from dipn_jax.planning.memory import MissedGrasps
from dipn_jax.sight import render
from dipn_jax.structs import ABSENT, Scene

SIDE = 0.04
"""Metres: side of the cubes."""


def _height(*centers: tuple[float, float], turned: float = 0.0, shape: tuple[int, ...] = (0, 0)) -> np.ndarray:
    """Return the height map of two cubes; the first is turned by an angle (radians)."""
    ones = np.ones(2, np.float32)
    scene = Scene(np.array(shape), np.full((2, 3), SIDE, np.float32), np.ones((2, 3), np.float32), ones, ones)
    turns = [(np.cos(turned / 2), 0, 0, np.sin(turned / 2)), (1, 0, 0, 0)]
    poses = [(x, y, SIDE / 2, *turn) for (x, y), turn in zip(centers, turns, strict=True)]
    return np.asarray(render.render(scene, np.array(poses, np.float32)).height)


def _pixel(x: float, y: float) -> np.ndarray:
    col, row = np.asarray(geometry.metres_to_pixels(np.array([x, y], np.float32))).round()
    return np.array([3, row, col], np.int32)


FAR = (-0.15, -0.15)
"""Where the second cube stands, unless it is near."""


def _remembered(before: np.ndarray, after: np.ndarray, at: tuple[float, float] = (0.0, 0.0)) -> bool:
    """Return whether a grasp that missed is remembered when the table looks otherwise."""
    return bool(MissedGrasps().add(_pixel(*at), before).recall(after).grasps)


def test_a_miss_is_remembered_until_something_near_it_moves() -> None:
    before = _height((0, 0), FAR)
    assert _remembered(before, before)
    assert _remembered(before, _height((0.001, 0), FAR)) and not _remembered(before, _height((0.005, 0), FAR))
    assert not _remembered(before, _height((0, -0.005), FAR))
    assert not _remembered(before, _height((0, 0), FAR, turned=np.pi / 4)), "turned on the spot"
    assert not _remembered(before, _height((0, 0), FAR, shape=(ABSENT, 0))), "gone"
    assert _remembered(before, _height((0, 0), FAR, shape=(0, ABSENT))), "far away"
    assert not _remembered(before, _height((0, 0), (0, 0.06))), "something came near"
    for distance, kept in ((0.07, False), (0.09, True)):  # its near side is 2 cm nearer
        beside = _height((0, 0), (0, distance))
        assert _remembered(beside, _height((0, 0), (0, distance), shape=(0, ABSENT))) == kept


def test_small_motions_add_up() -> None:
    remembered = MissedGrasps().add(_pixel(0, 0), _height((0, 0), FAR))
    for shift in (0.001, 0.002):
        remembered = remembered.recall(_height((shift, 0), FAR))
        assert remembered.grasps, "half a pixel is noise"
    assert not remembered.recall(_height((0.006, 0), FAR)).grasps


@pytest.mark.parametrize("noise", [0.002, 0.004])
def test_noise_of_the_camera_is_no_motion(noise: float) -> None:
    rng, still = np.random.default_rng(0), _height((0, 0), FAR)
    for _ in range(5):
        one, other = (still + rng.normal(0, noise, still.shape) for _ in range(2))
        assert _remembered(one, other)
        assert not _remembered(one, _height((0.006, 0), FAR) + rng.normal(0, noise, still.shape))


def test_a_grasp_at_the_border_is_compared_where_there_is_something_to_see() -> None:
    at = (0.22, 0.22)
    before, after = _height(FAR, (0.19, 0.19)), _height(FAR, (0.18, 0.18))
    assert _remembered(before, before, at) and not _remembered(before, after, at)


def test_changed_pixels_are_counted_in_a_disk() -> None:
    before = np.zeros((224, 224), np.float32)
    for apart, radius, kept in ((0, 3, True), (0, 5, False), (memory.RADIUS + 8, 5, True), (28, 5, False)):
        after = before.copy()
        cv2.circle(after, (112 + apart, 112), radius, 0.02, -1)
        assert _remembered(before, after) == kept, (apart, radius)
    corner = before.copy()
    corner[112 + 22 : 112 + 31, 112 + 22 : 112 + 31] = 0.02  # 81 pixels, all of them over 30 away
    assert _remembered(before, corner), "in the square around the disk only"
    low = before.copy()
    low[90:130, 90:130] = memory.CHANGED_HEIGHT * 0.99
    assert _remembered(before, low)


def test_the_latest_eight_are_remembered_in_order() -> None:
    height, remembered = np.zeros((224, 224), np.float32), MissedGrasps()
    np.testing.assert_array_equal(remembered.pixels(), np.full((8, 3), -1))
    for number in range(1, 11):
        remembered = remembered.add(np.array([number, 112, 112]), height)
        pixels = remembered.pixels()
        wanted = list(range(max(1, number - 7), number + 1))
        assert pixels[:, 0].tolist() == [*wanted, *[-1] * (8 - len(wanted))]
    assert len(remembered.recall(height).grasps) == len(remembered.around) == 8


def test_in_a_predicted_map_misses_are_forgotten_where_something_has_moved() -> None:
    before = _height((0, 0), FAR)
    missed = np.stack([_pixel(0, 0), _pixel(*FAR), np.full(3, -1, np.int32)])
    for after in (before, _height((0.05, 0), FAR), _height((0, 0), FAR, turned=np.pi / 4), _height((0, 0), (0, 0.15))):
        found = np.asarray(memory.forget_changed(missed, before, after))
        wanted = [missed[i] if _remembered(before, after, at) else np.full(3, -1) for i, at in enumerate([(0, 0), FAR])]
        np.testing.assert_array_equal(found, [*wanted, np.full(3, -1)])
