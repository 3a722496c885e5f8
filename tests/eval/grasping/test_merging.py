"""What was tried in parts comes together in the order of the tables."""

import pathlib

import numpy as np
import pytest
from dipn_jax.eval.grasping import merging, rates
from dipn_jax.eval.workers.shares import Part

from dipn_jax.errors import UserError
from dipn_jax.system import files


def _part(folder: pathlib.Path, shard: int, tables: list[int]) -> Part:
    """Write a part in which every number is that of its table, and each table has as many rows."""
    folder.mkdir()
    rows = np.repeat(tables, tables)
    arrays = {
        name: rows % 2 == 1 if form.kinds == "b" else rows.astype("f4" if form.kinds == "f" else int)
        for name, form in rates.FORMS.items()
    }
    merging.save(folder, arrays)
    listed = {merging.TRIED: files.file_sha256(folder / merging.TRIED)}
    return Part(folder, "grasp", shard, 2, 5, (), {}, {}, [], "", listed, {}, "", "")


def test_rows_are_in_the_order_of_the_tables(tmp_path: pathlib.Path) -> None:
    found = merging.pooled([_part(tmp_path / "b", 1, [2, 4]), _part(tmp_path / "a", 0, [1, 3, 5])])
    wanted = np.repeat(np.arange(1, 6), np.arange(1, 6))
    for name, form in rates.FORMS.items():
        np.testing.assert_array_equal(found[name], wanted % 2 == 1 if form.kinds == "b" else wanted, err_msg=name)


def test_arrays_of_another_form_are_one_line(tmp_path: pathlib.Path) -> None:
    part = _part(tmp_path / "a", 0, [1])
    np.savez(tmp_path / "a" / "x.npz", allow_pickle=False, table=np.zeros(2))
    (tmp_path / "a" / "x.npz").rename(tmp_path / "a" / merging.TRIED)
    part.files[merging.TRIED] = files.file_sha256(tmp_path / "a" / merging.TRIED)
    with pytest.raises(UserError, match=r"tried\.npz: damaged, array table is float64.*run its command again"):
        merging.pooled([part])
