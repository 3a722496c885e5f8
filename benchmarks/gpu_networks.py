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
from benchmarks.worker import FLOAT32, Worker
from dipn_jax.physics import make_engine
from dipn_jax.world import clutter, scenes

PRECISIONS = (FLOAT32, "bfloat16")
"""Precisions that networks are trained in."""


@dataclasses.dataclass
class Training:
    """A training step that is timed: of a network and a preset, in a precision."""

    name: str
    batch: int
    ours: Callable[[], None]  # a step
    theirs: Worker | None = None  # PyTorch, if it is installed


def training(size: Size) -> Found:
    """Measure samples a second of training steps, inputs ready, and over those of the same layers in PyTorch.

    All of them are compiled, and all processes of PyTorch started, at the same time; then they are timed in turns.
    """
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        made = list(_trainings(size, pathlib.Path(folder), stack))
        least = np.inf
        for each in made:
            ours = functools.partial(_steps, each.ours, size.steps)
            if each.theirs is None:
                yield f"{each.name}_samples_per_second", each.batch * size.steps / seconds(ours)
                yield each.name, "not measured: PyTorch is not installed; run pip install torch"
                continue
            mine, theirs = alternate(ours, functools.partial(each.theirs.steps, size.steps), repeats=size.repeats)
            least = min(least, theirs / mine)
            yield f"{each.name}_samples_per_second", each.batch * size.steps / mine
            yield each.name, theirs / mine
        if np.isfinite(least):
            yield "", least


def _steps(step: Callable[[], None], count: int) -> None:
    for _ in range(count):
        step()


def _trainings(size: Size, folder: pathlib.Path, stack: contextlib.ExitStack) -> Iterator[Training]:
    """Return all training steps, ready to be timed; processes end with `stack`."""
    waiting: list[concurrent.futures.Future[Training]] = []
    with COMPILING.counted(), concurrent.futures.ThreadPoolExecutor(8) as pool:
        for preset in size.presets:
            pushes = size.examples or push_net.BATCHES[preset]
            grasps = size.examples or bench_grasp.BATCHES[preset][0]
            episodes = max(8, 72 if size.examples is None else 4 * size.examples)
            arrays = push_net.training_examples(preset, pushes, size.seed, episodes=episodes)
            push = functools.partial(push_worker.jax_step, preset, arrays)
            waiting += _begin(pool, stack, push, f"push_{preset}", folder, arrays, "push_worker", (preset, pushes))
            arrays = bench_grasp.training_examples(preset, grasps, size.seed)
            grasp = functools.partial(grasp_worker.jax_step, preset, "train", arrays)
            waiting += _begin(pool, stack, grasp, f"grasp_{preset}", folder, arrays, "grasp_worker", (preset, "train"))
    for each in waiting:
        yield each.result()


def _begin(
    pool: concurrent.futures.ThreadPoolExecutor,
    stack: contextlib.ExitStack,
    ours: Callable[[str], tuple[Callable[[], None], int]],
    name: str,
    folder: pathlib.Path,
    arrays: dict[str, np.ndarray],
    module: str,
    arguments: tuple[Any, ...],
) -> list[concurrent.futures.Future[Training]]:
    """Let a thread of `pool` make each precision's step ready, in both frameworks."""
    file = folder / f"{name}.npz"
    np.savez(file, allow_pickle=False, **arrays)

    def make(precision: str) -> Training:
        other = Worker(module, "torch", *arguments, file, precision) if installed("torch") else None
        if other is not None:
            stack.callback(other.process.kill)
        step, _ = ours(precision)
        step()  # compiles
        return Training(f"{name}_{precision}", len(next(iter(arrays.values()))), step, other)

    return [pool.submit(make, precision) for precision in PRECISIONS]


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
