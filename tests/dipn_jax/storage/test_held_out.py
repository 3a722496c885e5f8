"""The rule that holds episodes out sees sizes in parts, and finds the same whatever the parts are."""

import pathlib

import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.storage import held_out


def _sizes(*lengths: int) -> np.ndarray:
    """Return sizes `[B, 2, 3]` of scenes that have these numbers of episodes."""
    return np.repeat(np.arange(1.0, len(lengths) + 1), lengths)[:, None, None] * np.full((1, 2, 3), 0.01)


@pytest.mark.parametrize("lengths", [(17, 2, 1), (1, 19), (3, 3, 3, 3, 3, 3, 3), (1,) * 40, (5, 1, 30, 2)])
@pytest.mark.parametrize("rows", [1, 2, 7, 18])
def test_parts_do_not_matter(lengths: tuple[int, ...], rows: int) -> None:
    size = _sizes(*lengths)
    parts = [size[at : at + rows] for at in range(0, len(size), rows)]
    whole = held_out.cut([size], len(size), pathlib.Path("data"))
    assert held_out.cut(parts, len(size), pathlib.Path("data")) == whole
    begun = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    np.testing.assert_array_equal(held_out.begins(size), begun)
    assert whole in begun[1:]


def test_of_two_that_are_as_near_the_first_is_taken_in_parts_too() -> None:
    size = _sizes(17, 2, 1)
    assert held_out.cut([size[:18], size[18:]], 20, pathlib.Path("data")) == 17


def test_a_row_goes_on_with_the_scene_before_it_or_begins_one() -> None:
    size = _sizes(2, 2)
    np.testing.assert_array_equal(held_out.begins(size[2:], before=size[1]), [0])
    np.testing.assert_array_equal(held_out.begins(size[1:], before=size[0]), [1])


def test_parts_of_one_scene_cannot_be_split() -> None:
    with pytest.raises(UserError, match="data set data: 6 examples of one scene"):
        held_out.cut([_sizes(3), _sizes(3)], 6, pathlib.Path("data"))
