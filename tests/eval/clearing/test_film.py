"""Films of tables are read where they are whole, and refused in one line where an array is not what it has to be."""

import pathlib
from collections.abc import Callable

import numpy as np
import pytest
from dipn_jax.eval.clearing import film
from dipn_jax.eval.report import comparison

from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments.fuzz_parsers import PARSERS

Arrays = dict[str, np.ndarray]


@pytest.fixture
def cleared_table(tmp_path: pathlib.Path) -> pathlib.Path:
    """Return the folder of an evaluation of one table, by one push and one grasp."""
    PARSERS["film"].prepare(tmp_path)
    return tmp_path


def _without(name: str) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.__delitem__(name)


def _to(name: str, value: np.ndarray) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({name: value})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_without("label"), "no array label"),
        (_to("what", np.zeros(2)), r"array what is float64 \[2\], want U"),
        (_to("what", np.array("push")), "array what is"),
        (_to("what", np.array(["push"] * 3)), "array push is"),
        (_to("mass", np.ones(4, np.float32)), r"array mass is float32 \[4\], want f \['N'\] with"),
        (_to("poses", np.ones((3, 3, 6), np.float32)), "array poses is"),
        (_to("shape", np.ones((3, 3), bool)), "array shape is bool"),
        (_to("what", np.array([{"a": 1}, 2], object)), "no file of arrays"),
    ],
)
def test_arrays_that_do_not_fit_are_one_line(
    change: Callable[[Arrays], None], says: str, cleared_table: pathlib.Path
) -> None:
    path = cleared_table / "episodes" / "000.npz"
    assert list(film.load(path).what) == ["push", "grasp held"]
    with np.load(path) as stored:
        arrays: Arrays = dict(stored)
    change(arrays)
    np.savez(path, **arrays)
    with pytest.raises(UserError, match=says) as caught:
        film.load(path)
    assert "\n" not in str(caught.value)


def test_as_many_states_as_actions_are_no_film(cleared_table: pathlib.Path) -> None:
    path = cleared_table / "episodes" / "000.npz"
    with np.load(path) as stored:
        arrays: Arrays = dict(stored)
    np.savez(path, **(arrays | {name: arrays[name][:2] for name in ("shape", "poses")}))
    with pytest.raises(UserError, match="2 actions, 2 states"):
        film.load(path)


@pytest.mark.parametrize("name", ["../000.npz", "/etc/hosts"])
def test_no_name_in_a_list_of_episodes_leads_out_of_its_folder(name: str, cleared_table: pathlib.Path) -> None:
    folder = cleared_table / "inner"
    PARSERS["film"].prepare(folder)
    (folder / "episodes" / "000.npz").rename(cleared_table / "000.npz")
    entries = files.read_json(folder / "episodes.json", wanted=list)
    files.write_json(folder / "episodes.json", [entries[0] | {"file": name}])
    one = comparison.Cleared(folder)
    with pytest.raises(UserError, match="is no file inside"):
        comparison.share_left(one, np.ones(1))
