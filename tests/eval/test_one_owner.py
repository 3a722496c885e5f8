"""The folder of an evaluation has one owner at a time."""

import os
import pathlib

import pytest
from dipn_jax.eval import cli

from dipn_jax.commands import console
from dipn_jax.storage import owner

_ONE_OBJECT = ("--cases", "random", "--objects", "1")
COMMANDS = {
    "clear": ("--method", "gn", "--grasp-net", "grasp", *_ONE_OBJECT),
    "sweep": (
        *("--push-net", "dipn", "--grasp-net", "grasp", "--distances", "0.05:0.05:0.01", "--pushes", "0"),
        *_ONE_OBJECT,
    ),
    "grasp": ("--grasp-net", "grasp", "--scenes", "1", "--objects", "1"),
    "prediction": ("--push-net", "dipn", "--scenes", "1", "--objects", "1"),
}
"""Commands that a folder belongs to while they work, and the networks that they need; small, should they begin."""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_evaluation_into_a_folder_is_told_who_has_it(
    name: str, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = [str(runs[word]) if word in runs else word for word in COMMANDS[name]]
    with owner.owned(out):
        assert console.run("test", cli.COMMANDS, [name, *words, "--out", str(out)]) == 2
        said = capfd.readouterr().err
        assert said.startswith(f"error: {out}: in use by host ") and f", pid {os.getpid()}, " in said
        assert said.count("\n") == 1
        assert [path.name for path in out.iterdir()] == ["owner.json"]


def test_an_evaluation_that_fails_at_once_leaves_no_folder(
    runs: dict[str, pathlib.Path], tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("--method", "gn", "--grasp-net", str(runs["grasp"]), "--names", "nobody", "--out", str(tmp_path / "out"))
    assert console.run("test", cli.COMMANDS, ["clear", *words]) == 2
    assert "nobody" in capfd.readouterr().err and list(tmp_path.iterdir()) == []
