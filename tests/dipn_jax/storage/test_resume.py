"""What is kept of unfinished work comes back as it was; what somebody else put there is not taken up, and never run."""

import dataclasses
import os
import pathlib
import pickle
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval.clearing.instances import Instance

from dipn_jax.storage import serialization
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import Scene
from dipn_jax.system import files


class _Malicious:
    def __init__(self, path: pathlib.Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("name", ["partial.pickle", "partial.npz"])
def test_a_pickle_is_not_run_and_one_of_an_earlier_version_is_swept(tmp_path: pathlib.Path, name: str) -> None:
    (tmp_path / name).write_bytes(pickle.dumps(_Malicious(tmp_path / "ran")))
    partial = Partial(tmp_path, {})
    assert partial.load("fresh") == "fresh"
    partial.finish()
    assert not list(tmp_path.iterdir())


def test_an_array_of_objects_is_not_run(tmp_path: pathlib.Path) -> None:
    with (tmp_path / "partial.npz").open("wb") as stream:
        np.savez(stream, value=np.array([_Malicious(tmp_path / "ran")], object))
    assert Partial(tmp_path, {}).load("fresh") == "fresh"
    assert not (tmp_path / "ran").exists()


def test_a_state_comes_back_as_it_was(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene(np.zeros(2, int), np.ones((2, 3)), np.ones((2, 3), np.float32), np.ones(2), np.ones(2))
    missed = (np.array([0.1, np.nan, -np.inf]),)
    table = Instance("a", scene, np.zeros((2, 7)), 2, missed=missed, film=[{"values": np.ones(3, np.float16)}])
    state = (1, [table], {"x": [np.float32(0.1)], ("t", 2): None}, float("inf"), "\u00e9", True)
    Partial(tmp_path, {"seed": 1}).save(state)
    back = Partial(tmp_path, {"seed": 1}).load(None)
    assert back[0] == 1 and back[2:] == state[2:] and type(back[2]["x"][0]) is np.float32
    for field in dataclasses.fields(Instance):
        mine, theirs = getattr(table, field.name), getattr(back[1][0], field.name)
        assert type(mine) is type(theirs)
        np.testing.assert_equal(theirs, mine) if field.name != "scene" else None
    assert isinstance(back[1][0].scene, Scene)
    np.testing.assert_array_equal(back[1][0].scene.color, scene.color, strict=True)
    assert back[1][0].film[0]["values"].dtype == np.float16
    assert Partial(tmp_path, {"seed": 2}).load("fresh") == "fresh"
    assert "kept with other options or networks than now; begins anew" in capsys.readouterr().err


def test_a_state_of_other_sources_or_a_damaged_one_is_named_and_not_taken_up(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    partial = Partial(tmp_path, {})
    partial.save([1, np.arange(100)])
    monkeypatch.setattr(files, "code_digest", lambda *_: "other")
    assert Partial(tmp_path, {}).load("fresh") == "fresh"
    assert "kept by other sources" in capsys.readouterr().err
    data = bytearray(partial.path.read_bytes())
    data[data.index(np.arange(100).tobytes()) + 80] ^= 1
    partial.path.write_bytes(data)
    assert partial.load("fresh") == "fresh"
    assert "damaged" in capsys.readouterr().err


def test_what_is_not_registered_is_refused() -> None:
    for value in (object(), np.array([None]), {"x": {1}}):
        with pytest.raises(TypeError, match="cannot keep"):
            serialization.dumps(value)
