"""A training that was interrupted ends as one that was not, bit for bit; runs that act are in `test_loop` and
`test_baseline`.
"""

import dataclasses
import json
import os
import pathlib
import signal
from typing import Any

import numpy as np
import pytest
from dipn_jax.train import devices, log
from dipn_jax.train.grasp import GraspTask, PretrainTask
from dipn_jax.train.loop import TrainConfig, fit
from dipn_jax.train.push import PushTask

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint
from experiments.faults_found import arrays_of

BRIEF = TrainConfig(steps=6, batch=4, eval_every=3, save_every=3)
NAMES = ("push", "grasp-pretrain", "grasp")


def _task(name: str, data: dict[str, pathlib.Path]) -> Any:
    if name == "push":
        return PushTask(data["push"], DipnConfig(width=8), limit=None, centimetres=(5, 10))
    network = GraspConfig(width=8, coarse=8, blocks=1)
    return PretrainTask(data["images"], network) if name == "grasp-pretrain" else GraspTask((data["grasp"],), network)


def _state(run: pathlib.Path) -> list[np.ndarray]:
    """Return all arrays of a run's newest step: weights, and what only training needs."""
    folder, _ = checkpoint.newest(run)  # type: ignore[misc]
    model, train = (arrays_of(folder / part) for part in ("model", "train"))
    assert len(model) > 2 and len(train) > 2
    return [*model.values(), *train.values()]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_an_interrupted_run_ends_as_an_uninterrupted_one(
    name: str, data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = _task(name, data)
    fit(task, BRIEF, tmp_path / "whole")
    calls = 0

    def interrupt(_: object, examples: object) -> object:
        nonlocal calls
        calls += 1
        if calls == 4:
            os.kill(os.getpid(), signal.SIGTERM)  # the current step is finished first
        return examples

    monkeypatch.setattr(devices.OneDevice, "shard_batch", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fit(task, BRIEF, tmp_path / "cut")
    assert checkpoint.newest(tmp_path / "cut")[1]["step"] == 4  # type: ignore[index]
    fit(task, BRIEF, tmp_path / "cut")
    assert calls == 6, "no step is repeated"
    for a, b in zip(_state(tmp_path / "whole"), _state(tmp_path / "cut"), strict=True):
        np.testing.assert_array_equal(a, b)
    lines = [(tmp_path / run / "metrics.jsonl").read_text() for run in ("whole", "cut")]
    assert lines[0] == lines[1]
    assert [json.loads(line)["step"] for line in lines[0].splitlines()] == [3, 6]
    assert list((tmp_path / "cut" / "events").iterdir())


def test_the_best_step_is_saved_kept_and_known_to_a_run_that_goes_on(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is saved where no checkpoint was due, and stays when the run is resumed and is worse."""
    task, losses = _task("push", data), iter([0.5, 0.2, 0.9, 0.8, 0.7, 0.1])
    monkeypatch.setattr(task, "evaluate", lambda _: {"held_out_loss": next(losses)})
    plan = TrainConfig(steps=3, batch=4, optimizer="sgd", eval_every=1, save_every=100)
    for steps, kept, best in ((3, [2, 3], 2), (5, [2, 3, 5], 2), (6, [5, 6], 6)):
        fit(task, dataclasses.replace(plan, steps=steps), tmp_path)
        assert sorted(int(path.name) for path in (tmp_path / "checkpoints").iterdir()) == kept
        found = checkpoint.find(pathlib.Path(f"{tmp_path}@best"), network="dipn")
        assert int(found.name) == best


@pytest.mark.parametrize("step", [3, 6])
def test_a_step_that_cannot_be_saved_ends_the_run_with_one_line(
    step: int,
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The step in the middle is noticed when the next is saved, the last one at the end; then the run continues."""
    task, write = _task("push", data), checkpoint._write

    def full(folder: pathlib.Path, *rest: Any) -> None:
        if folder.name.startswith(f".{step:08d}."):
            raise UserError(f"step {step} cannot be saved (No space left on device)")
        write(folder, *rest)

    monkeypatch.setattr(checkpoint, "_write", full)
    assert console.exit_code(lambda: bool(fit(task, BRIEF, tmp_path)) and 0) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert errors == [f"error: step {step} cannot be saved (No space left on device)"]
    found = checkpoint.newest(tmp_path)
    assert (found and found[1]["step"]) == (None if step == 3 else 3)
    monkeypatch.setattr(checkpoint, "_write", write)
    assert fit(task, BRIEF, tmp_path) and checkpoint.newest(tmp_path)[1]["step"] == 6  # type: ignore[index]


def test_an_interrupted_run_says_that_its_last_step_cannot_be_saved(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not that the same command continues from there."""
    task = _task("push", data)

    def interrupt(_: object, examples: object) -> object:
        os.kill(os.getpid(), signal.SIGTERM)
        return examples

    def full(*_: Any) -> None:
        raise UserError("step 1 cannot be saved")

    monkeypatch.setattr(devices.OneDevice, "shard_batch", interrupt)
    monkeypatch.setattr(checkpoint, "_write", full)
    with pytest.raises(UserError, match="step 1 cannot be saved"):
        fit(task, BRIEF, tmp_path)


def test_a_line_of_the_log_that_was_cut_or_damaged_is_dropped(tmp_path: pathlib.Path) -> None:
    good = '{"step": 2, "loss": 0.5}'
    (tmp_path / "metrics.jsonl").write_text("\n".join([good, "[" * 100_000, '{"step": "3"}', '{"step": 4, "lo']))
    curve = log.Log(tmp_path, 3, batch=4)
    assert (tmp_path / "metrics.jsonl").read_text() == good + "\n" and log.last(tmp_path) == {"step": 2, "loss": 0.5}
    curve.close()
