"""The rule that holds episodes out asks for the sizes near the cut alone, and finds what it would among all."""

import pathlib

import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.storage import held_out

DATA = pathlib.Path("data")


def _sizes(*lengths: int) -> np.ndarray:
    """Return sizes `[B, 2, 3]` of scenes that have these numbers of episodes."""
    return np.repeat(np.arange(1.0, len(lengths) + 1), lengths)[:, None, None] * np.full((1, 2, 3), 0.01)


def _cut(*lengths: int, reach: int = held_out.REACH) -> int:
    """Return the first episode that is held out; check that it is the nearest of those that begin a scene."""
    size = _sizes(*lengths)
    found = held_out.cut(size.__getitem__, len(size), DATA, reach=reach)
    begun = np.cumsum(lengths)[:-1].tolist()
    wanted = len(size) - min(1000, max(1, len(size) // 10))
    assert found == min(begun, key=lambda at: (abs(at - wanted), at))
    return found


@pytest.mark.parametrize("lengths", [(17, 2, 1), (1, 19), (3, 3, 3, 3, 3, 3, 3), (1,) * 40, (5, 1, 30, 2)])
@pytest.mark.parametrize("reach", [1, 2, 7, 18])
def test_how_far_it_looks_first_does_not_matter(lengths: tuple[int, ...], reach: int) -> None:
    assert _cut(*lengths, reach=reach) == _cut(*lengths)


def test_the_last_tenth_is_held_out_and_a_thousand_at_most() -> None:
    assert _cut(*[1] * 109) == 99 and _cut(*[1] * 20) == 18
    assert _cut(*[1] * 5) == 4 and _cut(1, 1) == 1, "one at least"
    assert _cut(*[1] * 10_500) == 9_500


@pytest.mark.parametrize("reach", [1, 100])
def test_the_cut_is_where_the_nearest_scene_begins(reach: int) -> None:
    # the last two of twenty are wanted
    cuts = [_cut(*lengths, reach=reach) for lengths in ((17, 3), (16, 3, 1), (15, 2, 3), (1, 19))]
    assert cuts == [17, 19, 17, 1]
    assert _cut(17, 2, 1, reach=reach) == 17, "of two that are as near, the first"


def test_only_what_is_near_the_cut_is_read() -> None:
    size, asked = _sizes(*[2] * 10_000), list[slice]()
    assert held_out.cut(lambda rows: asked.append(rows) or size[rows], 20_000, DATA) == 19_000
    assert [(one.start, one.stop) for one in asked] == [(18_899, 19_101)]


def test_a_row_goes_on_with_the_scene_before_it_or_begins_one() -> None:
    size = _sizes(2, 2)
    np.testing.assert_array_equal(held_out.begins(size), [0, 2])
    np.testing.assert_array_equal(held_out.begins(size[2:], before=size[1]), [0])
    np.testing.assert_array_equal(held_out.begins(size[1:], before=size[0]), [1])


@pytest.mark.parametrize("count", [1, 6, 3000])
def test_one_scene_cannot_be_split(count: int) -> None:
    with pytest.raises(UserError, match=f"data set data: {count} examples of one scene"):
        held_out.cut(_sizes(count).__getitem__, count, DATA)
