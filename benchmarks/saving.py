"""What checkpoints cost a training: the compact DIPN with and without them."""

from __future__ import annotations

import pathlib
import statistics
import tempfile
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from dipn_jax.train.cli import PUSH
from dipn_jax.train.loop import make_step
from dipn_jax.train.optimizers import make_optimizer
from dipn_jax.train.push import PushTask
from flax import nnx

from benchmarks.harness import Setting, seconds
from benchmarks.push_net import BATCHES, small_task
from dipn_jax.storage import checkpoint, saving

OFTEN = 25
"""Steps between the checkpoints that are timed: ten times as many as in a training, so that their cost shows."""


def cost(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds a step with a checkpoint every OFTEN steps over those without, and what that is in a training.

    Three ways of training take turns: without checkpoints, with them in the background, and in line, as before.
    """
    steps, repeats = setting.pick(100, 250), setting.pick(3, 7)
    with tempfile.TemporaryDirectory() as name:
        training = Training(name, small_task(name, "compact", setting.seed), setting.seed)
        training.steps(2, how="none")  # compiles
        times: dict[str, list[float]] = {"none": [], "background": [], "in_line": []}
        for repeat in range(repeats):
            for how in list(times)[:: 1 if repeat % 2 else -1]:
                times[how].append(seconds(lambda how=how: training.steps(steps, how=how)))  # type: ignore[misc]
    medians = {how: statistics.median(found) for how, found in times.items()}
    ratios = {how: medians[how] / medians["none"] for how in ("background", "in_line")}
    share = OFTEN / PUSH.save_every
    yield "train.saving", 1 + (ratios["background"] - 1) * share
    yield "train.saving/in_line", 1 + (ratios["in_line"] - 1) * share
    yield f"train.saving/every_{OFTEN}", ratios["background"]
    yield f"train.saving/in_line_every_{OFTEN}", ratios["in_line"]
    yield "train.saving/milliseconds_a_step", 1000 * medians["none"] / steps


class Training:
    """A training of the compact DIPN without an end."""

    def __init__(self, folder: str, task: PushTask, seed: int) -> None:
        self.run, self.task = pathlib.Path(folder) / "run", task
        self.model: Any = checkpoint.build("dipn", self.task.network_config, seed=seed)
        parts: Any = nnx.split(self.model, nnx.Param, ...)
        self.graph, self.params, self.rest = parts
        optimizer = make_optimizer(PUSH)
        self.moments = optimizer.init(self.params)
        self.step, self.done = make_step(self.task, self.graph, optimizer), 0
        self.rng = np.random.default_rng(seed)

    def steps(self, count: int, *, how: str) -> None:
        """Train for some steps, saving some of them `in_line`, in the `background`, or `none`."""
        config = self.task.network_config
        with saving.Saver(self.run, network="dipn", config=config) as saver:
            for k in range(1, count + 1):
                batch = self.task.fetch(self.rng.integers(self.task.size, size=BATCHES["compact"]))
                key = jax.random.key(self.done)
                self.params, self.rest, self.moments, _ = self.step(self.params, self.rest, self.moments, batch, key)
                self.done += 1
                if k % OFTEN == 0:
                    jax.block_until_ready(self.params)  # as the loop does where it looks for infinite weights
                    parts = {"model": nnx.state(nnx.merge(self.graph, self.params, self.rest)), "train": self.moments}
                    if how == "background":
                        saver.save(self.done, parts, extra={})
                    elif how == "in_line":
                        checkpoint.save(self.run, self.done, parts, network="dipn", config=config, extra={})
            jax.block_until_ready(self.params)
