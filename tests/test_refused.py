"""Values of options that would fill all memory, or that mean something else than they seem to: one line each."""

import errno
import os
import pathlib
from typing import Any

import pytest
from dipn_jax.datagen import cli as datagen_cli
from dipn_jax.eval import cli as eval_cli
from dipn_jax.train import cli as train_cli

from dipn_jax.commands import console
from dipn_jax.storage import checkpoint

COMMANDS = {"datagen": datagen_cli.COMMANDS, "train": train_cli.COMMANDS, "eval": eval_cli.COMMANDS}


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]):
    def run(stage: str, words: tuple[object, ...], *, says: str) -> None:
        assert console.run("test", COMMANDS[stage], [str(word) for word in words]) == 2
        error = capfd.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error, error

    return run


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        ("train", ("grasp-pretrain", "--data", "data", "--batch", 10**11)),
        ("train", ("grasp-pretrain", "--data", "data", "--steps", 10**23)),
        ("train", ("grasp-online", "--tables", 10**9)),
        ("train", ("baseline", "--batch", 10**9)),
        ("eval", ("clear", "--method", "gn", "--grasp-net", "builtin", "--cases", "random", "--instances", 10**9)),
        ("eval", ("grasp", "--grasp-net", "builtin", "--scenes", 10**9)),
        ("eval", ("prediction", "--push-net", "builtin", "--scenes", 10**9)),
        ("datagen", ("images", "--episodes", 10**12, "--shard-size", 10**12)),
    ],
)
def test_counts_that_no_memory_holds(stage: str, words: tuple[object, ...], refused, tmp_path: pathlib.Path) -> None:
    option, value = words[-2:] if stage != "datagen" else words[1:3]
    shown = f"{float(str(value)):.3g}" if option in ("--steps", "--episodes") else value
    refused(stage, (*words, "--out", tmp_path / "o"), says=f"{option} {shown}: want")
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        ("datagen", ("push", "--episodes", 1, "--objects", 1)),
        ("datagen", ("images", "--episodes", 1, "--objects", 1)),
        ("datagen", ("export", "DATA", "--format", "npz")),
        ("train", ("push", "--data", "DATA", "--steps", 1)),
        ("train", ("grasp-online", "--objects", 1)),
        ("train", ("baseline", "--method", "rea", "--objects", 1)),
        ("train", ("export", "--run", "builtin", "--network", "grasp")),
        ("eval", ("clear", "--method", "gn", "--grasp-net", "builtin", "--cases", "hard", "--names", "01")),
        ("eval", ("prediction", "--push-net", "builtin", "--scenes", 1, "--objects", 1)),
        ("eval", ("grasp", "--grasp-net", "builtin", "--scenes", 1, "--objects", 1)),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_a_folder_on_a_read_only_disk(
    stage: str,
    words: tuple[object, ...],
    refused,
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No folder can be made in it; the disk is imitated, since a superuser may write anywhere."""
    make = os.mkdir

    def mkdir(path: str | os.PathLike[str], *rest: Any, **how: Any) -> None:
        if pathlib.Path(path).is_relative_to(tmp_path):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        make(path, *rest, **how)

    monkeypatch.setattr(os, "mkdir", mkdir)
    words = tuple(data["push"] if word == "DATA" else word for word in words)
    refused(stage, (*words, "--out", tmp_path / "o"), says="Read-only file system")
    assert not list(tmp_path.iterdir())


def test_a_data_set_on_a_disk_that_became_read_only(
    refused, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """More episodes are asked for, but no file can be opened to be written; what is there stays as it is."""
    folder = tmp_path / "images"
    words = ("images", "--out", folder, "--objects", 1, "--shard-size", 1, "--engine", "native", "--episodes")
    assert console.run("test", COMMANDS["datagen"], [*map(str, words), "1"]) == 0
    capfd.readouterr()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    open_file = os.open

    def opened(path: Any, flags: int, *rest: Any, **how: Any) -> int:
        if flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR) and tmp_path in pathlib.Path(path).parents:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return open_file(path, flags, *rest, **how)

    def written(path: pathlib.Path, mode: str = "r", *rest: Any, **how: Any) -> Any:
        if set(mode) & set("wax+") and tmp_path in path.parents:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return open_path(path, mode, *rest, **how)

    open_path = pathlib.Path.open
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", opened)
        patch.setattr(pathlib.Path, "open", written)
        refused("datagen", (*words, 2), says="Read-only file system")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_names_that_mean_something_else(refused, tmp_path: pathlib.Path) -> None:
    """A step's folder is no run, and what comes with the package is no folder here; a case is not counted twice."""
    step = tmp_path / "run" / "checkpoints" / "00000004"
    for words in (("grasp-pretrain", "--data", "data"), ("grasp-online",)):
        refused("train", (*words, "--out", step), says=f"the folder of a step; give its run, {tmp_path / 'run'}")
    out = ("--out", tmp_path / "e")
    shipped = checkpoint.SHIPPED / "grasp"
    refused("eval", ("grasp", "--grasp-net", "builtin@1", *out), says=f"no such step of {shipped}; it has ")
    twice = ("clear", "--method", "gn", "--grasp-net", "builtin", "--names", "01", "01", *out)
    refused("eval", twice, says="--names 01 01: want none twice")
    assert not list(tmp_path.iterdir())
