"""Commands that learn while they act: what they start from, and what their tables are made of."""

import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.train import cli
from dipn_jax.train.online import baseline
from dipn_jax.train.online import grasping as online
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks.vpg import VpgConfig
from dipn_jax.storage import checkpoint
from dipn_jax.system import files
from dipn_jax.world import scenes

PARTS = {"vpg": (("push", "grasp"), "value"), "rea": (("grasp",), "chance"), "dqn": (("push",), "value")}
ALMOST_NO_LEARNING = {"actions": 4, "tables": 4, "updates": 1, "batch": 4, "learning_rate": 1e-9}


def saved(run: pathlib.Path, method: str, width: int = 8) -> nnx.Module:
    parts, answers = PARTS[method]
    config = VpgConfig(parts=parts, answers=answers, width=width, coarse=8)
    model = checkpoint.build("vpg", config, seed=3)
    checkpoint.save(run, 1, {"model": nnx.state(model)}, network="vpg", config=config, extra={})
    return model


@pytest.mark.slow
def test_a_compared_method_starts_from_a_run_of_it(engine: Any, tmp_path: pathlib.Path) -> None:
    saved(tmp_path / "begun", "rea")
    initial: Any = checkpoint.load_network(tmp_path / "begun", network="vpg")
    before = checkpoint.digest(initial)
    some, config = scenes.fixed_count(3, spread=0.2), baseline.BaselineConfig("rea", **ALMOST_NO_LEARNING)  # type: ignore[arg-type]
    baseline.learn(engine, some, config, tmp_path / "run", initial=initial)
    assert files.read_json(tmp_path / "run" / "config.json")["initial_weights"] == before
    assert checkpoint.digest(initial) == before, "what is given is left as it is"
    tuned = checkpoint.load_network(tmp_path / "run", network="vpg")
    for a, b in zip(*(jax.tree.leaves(nnx.state(one, nnx.Param)) for one in (initial, tuned)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)  # the rate is next to nothing
    with pytest.raises(UserError, match="begun with initial_weights"):
        baseline.learn(engine, some, config, tmp_path / "run")


@pytest.mark.parametrize("method", PARTS)
def test_a_run_of_another_method_is_refused(method: Any, engine: Any, tmp_path: pathlib.Path) -> None:
    gn: dict[str, Any] = {"scorer": lambda images: images} if method == "dqn" else {}
    for other in set(PARTS) - {method}:
        saved(tmp_path / other, other)
        wrong: Any = checkpoint.load_network(tmp_path / other, network="vpg")
        with pytest.raises(UserError, match=f"--init: holds .*, want .* for --method {method}"):
            config = baseline.BaselineConfig(method)
            baseline.learn(engine, scenes.SceneConfig(), config, tmp_path / "new", initial=wrong, **gn)
    assert not (tmp_path / "new").exists()


def test_a_published_network_goes_on_as_one(tmp_path: pathlib.Path) -> None:
    """The windows that it learns from are as large as its architecture wants, whatever `--preset` says."""
    model: Any = checkpoint.build("vpg", VpgConfig("paper", ("push",), blocks=(1, 1, 1, 1)))
    seen: list[Any] = []

    class Stop(Exception):
        pass

    def run(out: pathlib.Path, identity: dict[str, Any]) -> None:
        seen.append(identity["preset"])
        raise Stop

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(baseline, "Run", run)
        scorer: Any = object()
        baseline.learn(
            scorer, scenes.SceneConfig(), baseline.BaselineConfig("dqn"), tmp_path, initial=model, scorer=scorer
        )
    assert seen == ["paper"]


def test_what_tables_are_made_of_is_an_option_and_is_recorded(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []

    def learn(*arguments: Any, **_: Any) -> dict[str, float]:
        given.extend(one for one in arguments if isinstance(one, scenes.SceneConfig))
        return {}

    monkeypatch.setattr(baseline, "learn", learn)
    monkeypatch.setattr(online, "learn", learn)
    ranges = ["--items", "cube", "--scale", "0.95", "1", "--density", "100", "200", "--friction", "0.3", "0.3"]
    for name in ("baseline", "grasp-online"):
        assert console.run("test", cli.COMMANDS, [name, "--out", str(tmp_path / name), "--objects", "2", *ranges]) == 0
    for scene in given:
        assert scene.slots == 2 and scene.ranges.items == ("cube",) and scene.ranges.density == (100, 200)
        assert scene.ranges.scale == (0.95, 1) and scene.ranges.friction == (0.3, 0.3)
    assert len(given) == 2 and given[0] == given[1]
    monkeypatch.undo()
    engine: Any = object()
    identity = baseline._identity(engine, given[0], baseline.BaselineConfig(), "", None)
    assert "items=('cube',)" in identity["scenes"] and "density=(100.0, 200.0)" in identity["scenes"]


def test_mistakes_are_one_line(tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]) -> None:
    saved(tmp_path / "rea", "rea")
    for words, says in (
        (["--init", "builtin"], "no vpg network comes with this package"),
        (["--init", str(tmp_path / "nowhere")], "no such folder"),
        (["--init", str(tmp_path / "rea")], "holds chances of grasp, want values of push and grasp for --method vpg"),
        (["--items", "ball"], "--items ball: not in the catalogue"),
        (["--scale", "1.1", "0.9"], "--scale 1.1 0.9"),
    ):
        assert console.run("test", cli.COMMANDS, ["baseline", "--out", str(tmp_path / "run"), *words]) == 2
        error = capfd.readouterr().err
        assert says in error and error.count("\n") == 1, error
    assert not (tmp_path / "run").exists()
