"""Stages of `on_gpu` about networks and images: training against PyTorch, decisions, the renderer."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import pathlib
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from benchmarks import bench_grasp, grasp_worker, push_net, push_worker, rendering
from benchmarks.gpu_correctness import check_scores, policy, recall_nothing, table_slots
from benchmarks.gpu_stage import COMPILING, Found, Size, installed
from benchmarks.harness import alternate, seconds
from benchmarks.worker import Worker
from dipn_jax.physics import make_engine
from dipn_jax.world import clutter, scenes


@dataclasses.dataclass(frozen=True)
class Step:
    """A training step: of a network and a preset, on the same inputs in both frameworks."""

    name: str
    arrays: dict[str, np.ndarray]  # [B, ...]
    ours: Callable[[dict[str, np.ndarray], str], tuple[Callable[[], None], int]]  # of a precision
    module: str  # of PyTorch's process
    arguments: tuple[object, ...]

    @property
    def batch(self) -> int:
        """Number of examples."""
        return len(next(iter(self.arrays.values())))


@dataclasses.dataclass(frozen=True)
class Ready:
    """A step that has been taken once, in a precision."""

    step: Step
    precision: str
    ours: Callable[[], None]
    theirs: Worker | None  # PyTorch, if it is installed


def training(size: Size) -> Found:
    """Measure samples a second of training steps, inputs ready, and over those of the same layers in PyTorch.

    All of them are compiled, and all processes of PyTorch started, at the same time; then they are timed in turns.
    """
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        least = np.inf
        for each in _made_ready(size, pathlib.Path(folder), stack):
            name = f"{each.step.name}_{each.precision}"
            ours = functools.partial(_repeat, each.ours, size.steps)
            if each.theirs is None:
                yield f"{name}_samples_per_second", each.step.batch * size.steps / seconds(ours)
                yield name, "not measured: PyTorch is not installed; run pip install torch"
                continue
            mine, theirs = alternate(ours, functools.partial(each.theirs.steps, size.steps), repeats=size.repeats)
            least = min(least, theirs / mine)
            yield f"{name}_samples_per_second", each.step.batch * size.steps / mine
            yield name, theirs / mine
        if np.isfinite(least):
            yield "", least


def _repeat(step: Callable[[], None], count: int) -> None:
    for _ in range(count):
        step()


def _steps(size: Size) -> Iterator[Step]:
    """Return the training steps of both networks and all presets."""
    for preset in size.presets:
        batch = size.examples or push_net.BATCHES[preset]
        arrays = push_net.training_examples(preset, batch, size.seed, episodes=72 if size.examples is None else 8)
        ours: Any = functools.partial(push_worker.jax_step, preset)
        yield Step(f"push_{preset}", arrays, ours, "push_worker", (preset, batch))
        batch = size.examples or bench_grasp.BATCHES[preset][0]
        arrays = bench_grasp.training_examples(preset, batch, size.seed)
        ours = functools.partial(grasp_worker.jax_step, preset, "train")
        yield Step(f"grasp_{preset}", arrays, ours, "grasp_worker", (preset, "train"))


def _made_ready(size: Size, folder: pathlib.Path, stack: contextlib.ExitStack) -> list[Ready]:
    """Return all steps in all precisions; processes end with `stack`."""

    def make(step: Step, precision: str) -> Ready:
        file, theirs = folder / f"{step.name}.npz", None
        if installed("torch"):
            theirs = Worker(step.module, "torch", *step.arguments, file, precision)
            stack.callback(theirs.process.kill)
        ours, _ = step.ours(step.arrays, precision)
        ours()  # compiles
        return Ready(step, precision, ours, theirs)

    with COMPILING.counted(), concurrent.futures.ThreadPoolExecutor(8) as pool:
        waiting = []
        for step in _steps(size):
            np.savez(folder / f"{step.name}.npz", allow_pickle=False, **step.arrays)
            waiting += [pool.submit(make, step, precision) for precision in size.precisions]
        return [each.result() for each in waiting]


def decisions(size: Size) -> Found:
    """Measure decisions a second on many tables at once, and milliseconds a table: what is seen, masks, Alg. 2."""
    config = dataclasses.replace(scenes.fixed_count(size.objects), slots=table_slots())
    items = clutter.settled_scenes(jax.random.key(size.seed), make_engine("native"), config, size.tables)
    keys, decide = jax.random.split(jax.random.key(size.seed), size.tables), policy(size)
    check_scores(decide(keys, items.scene, items.poses, recall_nothing)[0])  # compiles
    taken = min(seconds(lambda: decide(keys, items.scene, items.poses, recall_nothing)) for _ in range(size.repeats))
    yield "milliseconds_a_table", 1000 * taken / size.tables
    yield "candidates", size.candidates
    yield "", size.tables / taken


def render(size: Size) -> Found:
    """Measure images a second over those of MuJoCo's ray caster on all cores, of many scenes at once."""
    mine, theirs = rendering.times(size.seed, size.images, repeats=size.repeats)
    yield "images_per_second", size.images / mine
    yield "", theirs / mine
