import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.train import cli
from dipn_jax.train.loop import TrainConfig
from dipn_jax.train.online import grasping as online
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint
from dipn_jax.system import files
from dipn_jax.world import scenes


@pytest.mark.slow
def test_the_refusal_of_more_steps_says_how_and_a_run_starts_from_another(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    brief = TrainConfig(steps=1, batch=2)
    cli.push(data["push"], tmp_path / "a", init=pathlib.Path("builtin"), config=brief)
    begun = checkpoint.load_network("builtin", network="dipn")
    tuned = checkpoint.load_network(tmp_path / "a", network="dipn")
    assert tuned.config == begun.config
    for a, b in zip(*(jax.tree.leaves(nnx.state(one, nnx.Param)) for one in (begun, tuned)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)  # the rate of the first step is 0
    with pytest.raises(UserError, match=f"is planned for --steps 1, .* --init {tmp_path / 'a'} and another --out"):
        cli.push(data["push"], tmp_path / "a", init=pathlib.Path("builtin"), config=TrainConfig(steps=2, batch=2))


def test_options_data_and_folder_can_be_checked_without_writing(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    push = ["push", "--data", str(data["push"]), "--out", str(out), "--check-only"]
    assert console.run("test", cli.COMMANDS, push) == 0
    said = capfd.readouterr()
    assert said.out == f"{out}: nothing is wrong with options and data\n" and not out.exists()
    assert said.err == "train dipn: 1500 steps of 32 examples; each of 20 is seen 2,400 times on average\n"
    assert console.run("test", cli.COMMANDS, [*push, "--limit", "99"]) == 2
    assert "--limit 99: want 1 to 20" in capfd.readouterr().err and not out.exists()
    files.write_json(out / "config.json", {"network": "grasp"})
    for optimizer in ("adamw", "sgd"):
        assert console.run("test", cli.COMMANDS, [*push, "--optimizer", optimizer]) == 2
        assert f"{out}: begun with network=grasp, asked for network=dipn" in capfd.readouterr().err
    assert [path.name for path in out.iterdir()] == ["config.json"]


@pytest.mark.parametrize("command", ["push", "grasp-pretrain", "grasp"])
def test_options_are_checked_before_the_data(
    command: str, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for wrong, says in (
        (["--steps", "0"], "--steps 0: want a number above 0"),
        (["--memory", "nan"], "--memory nan: want 0 to"),
        (["--batch", "8", "--accumulate", "3"], "--batch 8 --accumulate 3: want a number that divides"),
        (["--mix", "1", "2"], "--mix 1 2: want a number for each folder of --data, 1"),
        (["--out", str(tmp_path / "file" / "run")], "is not a folder"),
        (["--process", "3"], "--processes 1 --process 3: needs --coordinator"),
    ):
        words = [command, "--data", str(tmp_path / "none"), "--out", str(tmp_path / "run"), *wrong]
        assert console.run("test", cli.COMMANDS, words) == 2
        assert says in capfd.readouterr().err, wrong


@pytest.mark.slow
def test_learning_online_stops_at_a_loss_that_is_not_finite(engine: Any, tmp_path: pathlib.Path) -> None:
    plan = online.OnlineConfig(grasps=6, tables=2, updates=2, batch=4, learning_rate=1e39)
    network = GraspConfig(width=8, coarse=8, blocks=1)
    with pytest.raises(UserError, match="not finite"):
        online.learn(checkpoint.build("grasp", network), engine, scenes.fixed_count(3, spread=0.2), plan, tmp_path)
    assert not (tmp_path / "checkpoints").exists()
