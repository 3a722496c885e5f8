"""Values of options that would fill all memory, or that mean something else than they seem to: one line each."""

import pathlib

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
