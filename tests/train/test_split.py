"""Which examples are held out."""

import pathlib

import numpy as np
import pytest
from dipn_jax.train.split import first, split

from dipn_jax.errors import UserError
from dipn_jax.structs import Scene, SettledScene


def _examples(*lengths: int) -> SettledScene:
    """Return examples, a given number of each scene; their poses are their numbers, and scenes differ in one size."""
    count = sum(lengths)
    size = np.full((count, 2, 3), 0.05, np.float32)
    size[:, 1, 2] = np.repeat(np.arange(len(lengths)) % 2, lengths)
    ones = np.ones((count, 2), np.float32)
    scene = Scene(np.zeros((count, 2), np.int32), size, np.ones((count, 2, 3), np.float32), ones, ones)
    poses = np.broadcast_to(np.arange(count, dtype=np.float32)[:, None, None], (count, 2, 7))
    return SettledScene(scene=scene, poses=poses, fault=np.zeros(count, np.int32))


def _cut(*lengths: int) -> int:
    """Return the first example that is held out; check that none is lost."""
    examples = _examples(*lengths)
    kept, held = split(examples, pathlib.Path("data"))
    np.testing.assert_array_equal(np.concatenate([kept.poses, held.poses]), examples.poses)
    return len(kept.poses)


def test_the_last_tenth_is_held_out_and_a_thousand_at_most() -> None:
    assert _cut(*[1] * 109) == 99 and _cut(*[1] * 20) == 18
    assert _cut(*[1] * 5) == 4 and _cut(1, 1) == 1, "one at least"
    assert _cut(*[1] * 10_500) == 9_500


def test_the_cut_is_where_the_nearest_scene_begins() -> None:
    # the last two of twenty are wanted
    assert _cut(17, 3) == 17 and _cut(16, 3, 1) == 19 and _cut(15, 2, 3) == 17 and _cut(1, 19) == 1
    assert _cut(17, 2, 1) == 17, "of two that are as near, the first"


def test_one_scene_cannot_be_split() -> None:
    with pytest.raises(UserError, match="data set data: 7 examples of one scene"):
        split(_examples(7), pathlib.Path("data"))


def test_a_limit_keeps_the_first_ones() -> None:
    examples = _examples(2, 3)
    for limit in (1, 5, None):
        kept = first(examples, limit, what="images")
        np.testing.assert_array_equal(kept.poses, examples.poses[:limit])
    for limit in (0, 6):
        with pytest.raises(UserError, match=f"--limit {limit}: want 1 to 5, the images of --data"):
            first(examples, limit, what="images")
