"""DIPN: training against PyTorch, the cost of its inputs, candidates in one call against one call each."""

from __future__ import annotations

import importlib.util
import pathlib
import tempfile
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from dipn_jax.datagen.generate import Job, generate
from dipn_jax.train.loop import TrainConfig, make_step
from dipn_jax.train.optimizers import make_optimizer
from dipn_jax.train.push import PushTask
from flax import nnx

from benchmarks import push_worker
from benchmarks.harness import Setting, Skipped, alternate, quiet
from benchmarks.worker import versus
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.physics import make_engine
from dipn_jax.planning import candidates, predictors
from dipn_jax.sight import render
from dipn_jax.storage import checkpoint
from dipn_jax.world import clutter, scenes

BATCHES = {"compact": 32, "paper": 8}
"""Examples per step, as in the presets."""
CANDIDATES = 64
"""Number of candidate pushes."""
OBJECTS = 10
"""Number of objects in a scene."""
USES = 64
"""Number of times that a training of 3,000 steps uses each of 1,500 pushes."""


def small_task(folder: str, preset: str, seed: int, *, episodes: int = 72) -> PushTask:
    """Return a training task on a small data set of 1 to 7 objects."""
    data = pathlib.Path(folder) / "data"
    with quiet():
        generate(
            Job(
                kind="push",
                scene=scenes.parse_objects("paper"),
                episodes=episodes,
                seed=seed,
                shard_size=episodes,
                actions=3,
                engine="native",
            ),
            data,
        )
    return PushTask(data, DipnConfig(preset=preset), limit=None, centimetres=tuple(range(1, 11)))


def training_examples(preset: str, batch: int, seed: int, *, episodes: int = 72) -> dict[str, np.ndarray]:
    """Return the inputs `[B, ...]` and the target `[B, N, 10, 3]` of a training step, by their names."""
    with tempfile.TemporaryDirectory() as name:
        task = small_task(name, preset, seed, episodes=episodes)
        examples = task.prepare(task.train_set.take(np.arange(batch)))
    arrays = {field: np.asarray(getattr(examples.inputs, field)) for field in push_worker.FIELDS}
    return {"target": np.asarray(examples.target), **arrays}


def vs_torch(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of a training step in PyTorch over ours, and our peak memory over PyTorch's."""
    if importlib.util.find_spec("torch") is None:
        raise Skipped("PyTorch is not installed; run pip install torch (the extra `bench`)")
    for preset, batch in BATCHES.items():
        with tempfile.TemporaryDirectory() as name:
            file = pathlib.Path(name) / "examples.npz"
            np.savez(file, allow_pickle=False, **training_examples(preset, batch, setting.seed))
            count = 1 if preset == "paper" else setting.pick(10, 40)
            figure, arguments = f"push_net.vs_torch/{preset}", (preset, batch, file)
            yield from versus(figure, "push_worker", arguments, batch=batch, count=count, repeats=setting.pick(3, 9))


def input_share(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of rendering a batch and moving it into the push frame, over that and a step.

    `/training` is what a training pays: examples of a `compact` network are rendered once, stay in memory, and are used
    `USES` times.
    """
    batch = BATCHES["compact"]
    with tempfile.TemporaryDirectory() as name:
        task = small_task(name, "compact", setting.seed)
        rows = np.arange(batch)
        episodes = task.train_set.take(rows)
        with quiet():
            kept = task.fetch(rows)
    model = checkpoint.build("dipn", task.network_config)
    graph, *state = nnx.split(model, nnx.Param, ...)
    optimizer = make_optimizer(TrainConfig())
    state.append(optimizer.init(state[0]))
    step, key = make_step(task, graph, optimizer), jax.random.key(setting.seed)
    inner = 5

    def prepare() -> None:
        for _ in range(inner):
            jax.block_until_ready(task.prepare(episodes))

    def learn() -> None:
        for _ in range(inner):
            *state[:], loss = step(*state, kept, key)
            loss.block_until_ready()

    def fetch() -> None:
        for _ in range(inner):
            task.fetch(rows)

    prepare()  # compiles
    learn()
    prepared, learnt = alternate(prepare, learn, repeats=setting.pick(5, 15))
    fetched, again = alternate(fetch, learn, repeats=setting.pick(5, 15))
    yield "push_net.input_share", prepared / (prepared + learnt)
    inputs = prepared / USES + fetched
    yield "push_net.input_share/training", inputs / (inputs + again)


def batched(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of one call for each candidate over one call for all: 64 pushes of a scene of 10 objects."""
    items = clutter.settled_scenes(jax.random.key(setting.seed), make_engine("native"), scenes.fixed_count(OBJECTS), 1)
    seen = jax.tree.map(lambda leaf: leaf[0], render.observe(items.scene, items.poses))
    key = jax.random.key(setting.seed)
    pushes, _ = candidates.sample_pushes(key, seen, count=CANDIDATES, distance=0.1)
    network: Any = checkpoint.build("dipn", DipnConfig())
    network.eval()
    predict = jax.jit(predictors.dipn_predictor(network))
    each = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], pushes) for i in range(CANDIDATES)]
    together = lambda: jax.block_until_ready(predict(seen, pushes))  # noqa: E731
    one_by_one = lambda: jax.block_until_ready([predict(seen, push) for push in each])  # noqa: E731
    apart = jnp.concatenate(one_by_one())
    if not np.allclose(together(), apart, atol=1e-3):
        raise RuntimeError("one call and a call for each candidate disagree")
    all_at_once, alone = alternate(together, one_by_one, repeats=setting.pick(5, 15))
    yield "push_net.batched", alone / all_at_once
    yield "push_net.batched/milliseconds", 1000 * all_at_once
