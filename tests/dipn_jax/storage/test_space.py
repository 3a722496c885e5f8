"""Arrays are in memory as far as it is granted, and in files that nothing is left of beyond."""

import pathlib
import shutil
import tempfile

import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.storage.space import FREE_DISK_BYTES, Space

LIKE = {"square": np.zeros((2, 3)), "half": np.zeros(2, np.float16)}
SIZE = 5 * (3 * 8 + 2)


def in_files(arrays: dict[str, np.ndarray]) -> list[bool]:
    """Return of each array whether it is in a file."""
    return [isinstance(array, np.memmap) for array in arrays.values()]


def test_memory_is_granted_once_and_again_when_it_is_free(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = Space(1.5e-9 * SIZE, tmp_path / "not" / "there")
    first = space.arrays(5, LIKE, what="rows")
    view = first["square"][1:]
    assert in_files(first) == [False, False] and not space.fits(SIZE) and not capsys.readouterr().out
    more = space.arrays(5, LIKE, what="rows")
    assert in_files(more) == [True, True]
    assert f"{tmp_path}: 0.0 MB of rows are kept in temporary files there" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [], "the files have no names"
    more["square"][:] = 7
    assert more["square"].shape == (5, 3) and more["half"].dtype == np.float16 and (more["square"] == 7).all()
    del first
    assert not space.fits(SIZE), "a view of some of it is there"
    del view
    assert space.fits(1.5 * SIZE) and in_files(space.arrays(5, LIKE, what="rows")) == [False, False]
    assert Space().fits(1e30), "without a folder there is no limit"
    assert space.arrays(0, {"none": np.zeros((1, 2))}, what="rows")["none"].shape == (0, 2)


def test_a_disk_without_room_is_one_line(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = shutil.disk_usage(tmp_path)._replace(free=int(FREE_DISK_BYTES) + SIZE - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    with pytest.raises(UserError, match=r"100\.0 MB are free, and rows need 0\.0 MB and some to spare; make room"):
        Space(0, tmp_path).arrays(5, LIKE, what="rows")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full._replace(free=int(FREE_DISK_BYTES) + SIZE))
    made, make = [], tempfile.TemporaryFile
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: made.append(dir) or make(dir=dir))  # type: ignore[func-returns-value]
    assert in_files(Space(0, tmp_path).arrays(5, LIKE, what="rows")) == [True, True]
    assert made == [tmp_path, tmp_path], "on the disk that has been looked at"
