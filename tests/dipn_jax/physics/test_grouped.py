"""A scene is simulated to the same bits with any others beside it."""

from typing import Any

import jax
import numpy as np

from dipn_jax import structs
from dipn_jax.physics import grouped, make_engine
from dipn_jax.structs import Grasp
from dipn_jax.world import clutter, primitives, scenes


def test_no_neighbour_changes_a_bit(engine: Any) -> None:
    """Fingers that come down on objects: in one of these scenes, one body more beside them moves them by 0.06 mm."""
    items = clutter.settled_scenes(jax.random.key(2), engine, scenes.parse_objects("2:3"), 16)
    beside = items.poses[:, 0, :2] + np.float32(0.01)
    grasps = Grasp(beside, np.linspace(0, 3, 16).astype(np.float32), np.full(16, 0.005, np.float32))
    counts = (items.scene.shape >= 0).sum(-1)
    assert set(counts) == {2, 3}

    def grasped(engine: Any, rows: np.ndarray) -> Any:
        scene, each = structs.take(items.scene, rows), structs.take(grasps, rows)
        return primitives.grasp(engine, scene, items.poses[rows], each)[0]

    apart = grouped.group_by_object_count(engine)
    together = grasped(apart, np.arange(16))
    for count in (2, 3):
        rows = np.flatnonzero(counts == count)
        alone = [grasped(apart, rows), grasped(engine, rows), grasped(apart, rows[::-1][:3])]
        for some, which in zip(alone, (rows, rows, rows[::-1][:3]), strict=True):
            for here, there in zip(jax.tree.leaves(some), jax.tree.leaves(together), strict=True):
                np.testing.assert_array_equal(here, there[which])


def test_engines_of_other_kinds_are_left_alone() -> None:
    mjx = make_engine("mjx")
    assert grouped.group_by_object_count(mjx) is mjx
