"""The cost of keeping a training's examples in files: the compact DIPN with examples in memory, and in files."""

from __future__ import annotations

import pathlib
import statistics
import tempfile
from collections.abc import Iterator

import numpy as np
from dipn_jax.train.push import PushTask

from benchmarks.harness import Setting, quiet, seconds
from benchmarks.push_net import BATCHES, small_task
from benchmarks.saving import Training
from dipn_jax.storage.space import Space


def cost(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure examples a second with examples and episodes in files over those with both in memory.

    Every example is made before; the two ways of training take turns, on the same examples in the same order.
    """
    episodes, steps, repeats = setting.pick(72, 1500), setting.pick(20, 100), setting.pick(3, 7)
    with tempfile.TemporaryDirectory() as name:
        in_memory = small_task(name, "compact", setting.seed, episodes=episodes)
        data, folder = pathlib.Path(name) / "data", pathlib.Path(name) / "files"
        distances = tuple(map(int, in_memory.centimetres))
        with quiet():
            in_files = PushTask(
                data, in_memory.network_config, limit=None, centimetres=distances, space=Space(0, folder)
            )
        training = Training(name, in_memory, setting.seed)
        tasks = {"memory": in_memory, "files": in_files}
        made: dict[str, float] = {}
        for way, task in tasks.items():
            with quiet():
                made[way] = seconds(lambda task=task: task.fetch(np.arange(task.size)))  # type: ignore[misc]
            training.task = task
            training.steps(2, how="none")
        times: dict[str, list[float]] = {name: [] for name in tasks}
        for repeat in range(repeats):
            for way in list(tasks)[:: 1 if repeat % 2 else -1]:
                training.task, training.rng = tasks[way], np.random.default_rng(repeat)
                times[way].append(seconds(lambda: training.steps(steps, how="none")))
        in_files.close()
    medians = {way: statistics.median(found) for way, found in times.items()}
    yield "train.from_files", medians["memory"] / medians["files"]
    yield "train.from_files/examples_per_second", steps * BATCHES["compact"] / medians["files"]
    yield "train.from_files/first_time", made["memory"] / made["files"]
