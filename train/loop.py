"""The training loop, from top to bottom; the data, the loss and the network are given as a `Task`."""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import os
import pathlib
from collections.abc import Callable
from typing import Any, Protocol

import jax
import numpy as np
import optax
import tensorboardX
from flax import nnx

from dipn_jax import console, files, seeds, typed
from dipn_jax.errors import UserError
from dipn_jax.interruption import Interruption
from dipn_jax.storage import checkpoint, owner, saving

from . import finite
from .configs import BaselineConfig, OnlineConfig, TrainConfig

logging.getLogger("absl").setLevel(logging.ERROR)  # Grain remarks on a profiler when it is imported
import grain  # noqa: E402

LONGEST_RISE = 1000
"""Steps that the rate of `published_rate` rises at most. Source: DIPN's released code."""


class Taught(Protocol):
    """The part of a task that an optimizer step needs."""

    def loss(self, model: nnx.Module, batch: Any, key: jax.Array) -> jax.Array:
        """Return the loss of a batch of examples, inside jit."""
        ...


class Task(Taught, Protocol):
    """Something to learn: data, a loss and a measure."""

    network: str  # key of checkpoint.NETWORKS
    network_config: Any
    size: int  # training examples
    examples: int  # what a learning curve counts
    fingerprint: str  # of the data

    def fetch(self, index: np.ndarray) -> Any:
        """Return the examples `index [B]`."""
        ...

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """Return measures on examples that are held out."""
        ...


def published_rate(config: TrainConfig, *, examples: int) -> optax.Schedule:
    """Return the learning rate of a step as DIPN's released code plans it.

    It rises from a thousandth during the first epoch (or LONGEST_RISE steps), and falls to a tenth after each third of
    the run. That code compares whole epochs with thirds, so that there it falls only if their number is a multiple of
    three, which the 50 of its README is not; the thirds are our reading.
    """
    rise = min(LONGEST_RISE, max(1, -(-examples // config.batch) - 1))
    thirds = {-(-k * config.steps // 3): 0.1 for k in (1, 2)}
    risen = optax.linear_schedule(config.learning_rate / 1000, config.learning_rate, rise)
    fallen = optax.piecewise_constant_schedule(1.0, thirds)
    return lambda step: risen(step) * fallen(step)


def make_optimizer(config: TrainConfig, *, examples: int = 0) -> optax.GradientTransformation:
    """Return the optimizer of a run on this number of examples, with its schedule."""
    if config.optimizer in ("sgd", "published"):
        constant = config.optimizer == "sgd"
        rate = config.learning_rate if constant else published_rate(config, examples=examples)
        return optax.chain(optax.add_decayed_weights(config.weight_decay), optax.sgd(rate, momentum=0.9))
    if config.optimizer == "adamw":
        warm = min(100, config.steps // 10 + 1)
        rate = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warm, max(config.steps, warm + 1))
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=config.weight_decay))
    raise UserError(f"--optimizer {config.optimizer}: want adamw, sgd or published")


def constant_adamw(config: OnlineConfig | BaselineConfig) -> optax.GradientTransformation:
    """The optimizer of a run that learns while it acts: AdamW with a constant rate."""
    adamw = optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
    return optax.chain(optax.clip_by_global_norm(1.0), adamw)


def _split(model: nnx.Module) -> tuple[Any, Any, Any]:
    """Split a network into its graph, its parameters and everything else (statistics, random streams)."""
    parts: Any = nnx.split(model, nnx.Param, ...)
    return parts


def make_step(task: Taught, graph: Any, optimizer: optax.GradientTransformation) -> Callable[..., Any]:
    """Return the jitted step `(params, rest, moments, batch, key) -> (params, rest, moments, loss)`.

    The first three arguments are donated.
    """

    @functools.partial(jax.jit, donate_argnums=(0, 1, 2))
    def step(params: Any, rest: Any, moments: Any, batch: Any, key: jax.Array) -> Any:
        def loss(p: Any) -> tuple[jax.Array, Any]:
            model = nnx.merge(graph, p, rest, copy=True)  # variables of this trace, which may be written
            model.train()
            value = task.loss(model, batch, key)
            return value, _split(model)[2]

        (value, new_rest), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        updates, moments = optimizer.update(gradient, moments, params)
        return optax.apply_updates(params, updates), new_rest, moments, value

    return step


def fit(task: Task, config: TrainConfig, out: pathlib.Path, *, initial: nnx.Module | None = None) -> dict[str, float]:
    """Train, or continue to train, in the folder `out`.

    Args:
      task: what to learn.
      config: how.
      out: run folder: `config.json`, `metrics.jsonl`, `events/` (TensorBoard), `checkpoints/`.
      initial: network to start from; a fresh one if not given.

    Returns:
      The last evaluation.

    Raises:
      UserError: the folder holds a run of another config or on other data, or another process has it; or a loss or
        a weight is not finite, after which nothing is saved.
    """
    _check(config, out)
    optimizer = make_optimizer(config, examples=task.size)
    with owner.owned(out):
        return _fit(task, config, out, optimizer, initial)


def _fit(
    task: Task,
    config: TrainConfig,
    out: pathlib.Path,
    optimizer: optax.GradientTransformation,
    initial: nnx.Module | None,
) -> dict[str, float]:
    """Train in a folder that this process owns; arguments as of `fit`."""
    model = initial or checkpoint.build(task.network, task.network_config, seed=config.seed)
    _claim(out, _identity(task, config, initial), config)
    moments, begin = _resume(out, model, optimizer)
    graph, params, rest = _split(model)
    order = grain.MapDataset.range(task.size).shuffle(seed=config.seed).repeat().batch(config.batch)
    step_fn = make_step(task, graph, optimizer)
    log = _Log(out, begin)
    key = seeds.key(config.seed, seeds.Purpose.TRAINING)
    latest: dict[str, float] = {}
    watch = finite.Watch(config.learning_rate, lambda k: np.asarray(order[k]), "the last finite checkpoint is kept")

    def save(step: int) -> None:
        parts = {"model": nnx.state(nnx.merge(graph, params, rest)), "train": moments}
        about = {"seed": config.seed, "data": task.fingerprint, "examples": task.examples, **latest}
        saver.save(step, parts, extra=about)

    step, saver = begin, saving.Saver(out, network=task.network, config=task.network_config)
    progress = console.Progress(f"train {task.network}", config.steps, unit="steps", done=begin)
    with progress, Interruption() as interruption, saver:
        while step < config.steps:
            batch = task.fetch(np.asarray(order[step]))
            params, rest, moments, loss = step_fn(params, rest, moments, batch, jax.random.fold_in(key, step))
            watch.see(step, loss)
            step += 1
            evaluating = step % config.eval_every == 0 or step == config.steps
            due = step % config.save_every == 0 or step == config.steps or interruption.requested
            if evaluating or due:
                watch.check(step, (params, rest, moments))
            if evaluating:
                model = nnx.merge(graph, params, rest)
                model.eval()
                latest = {"loss": float(loss), **task.evaluate(model)}
                watch.check(step, params, **latest)
                log.write(step, latest)
            if due or interruption.requested:
                save(step)
            if interruption.requested:
                saver.wait()
                raise KeyboardInterrupt
            progress.advance(1, " ".join(f"{k} {v:.3f}" for k, v in latest.items()))
    log.close()
    return latest or log.last()


def _check(config: TrainConfig, out: pathlib.Path) -> None:
    """Raise UserError where an option is out of its range or `out` cannot be written."""
    console.require_positive(
        steps=config.steps,
        batch=config.batch,
        learning_rate=config.learning_rate,
        eval_every=config.eval_every,
        save_every=config.save_every,
    )
    console.require_between(0, 1, weight_decay=config.weight_decay)
    console.require_seed(config.seed)
    console.require_out(out)


def _resume(out: pathlib.Path, model: nnx.Module, optimizer: optax.GradientTransformation) -> tuple[Any, int]:
    """Return the optimizer's state and the step to begin with; earlier weights of the run are put into `model`."""
    moments = optimizer.init(_split(model)[1])
    found = checkpoint.newest(out)
    if found is None:
        return moments, 0
    folder, meta = found
    nnx.update(model, checkpoint.restore(folder, "model", nnx.state(model)))
    return checkpoint.restore(folder, "train", moments), int(meta["step"])


def _identity(task: Task, config: TrainConfig, initial: nnx.Module | None) -> dict[str, Any]:
    """Return everything that determines the run; a flat dictionary, so that a difference can be named."""
    start = None if initial is None else checkpoint.digest(initial)
    network = {f"network.{k}": v for k, v in dataclasses.asdict(task.network_config).items()}
    data = {"network": task.network, "initial_weights": start, "data": task.fingerprint}
    return {**data, **network, **dataclasses.asdict(config)}


def _claim(out: pathlib.Path, identity: dict[str, Any], config: TrainConfig) -> None:
    """Claim the folder; a rate that is constant allows more steps.

    Raises:
      UserError: the folder holds another run, or one whose rate has fallen for another number of steps.
    """
    if config.optimizer == "sgd":
        return files.claim(out, identity, free=("steps",))
    path = out / "config.json"
    begun = files.read_json(path).get("steps", config.steps) if path.exists() else config.steps
    files.claim(out, identity | {"steps": begun})
    if begun != config.steps:
        raise UserError(
            f"{out}: its learning rate is planned for --steps {begun}, so that it cannot go on to {config.steps}; give "
            f"--init {out} and another --out to train on, or --optimizer sgd (a constant rate) from the start"
        )


def _step_of(line: str) -> float:
    """Return the step of a line of `metrics.jsonl`; infinite if a hard stop cut the line."""
    try:
        return float(typed.check(typed.parse(line), {"step": float})["step"])
    except typed.Misfit:
        return float("inf")


class _Log:
    """Writer of `metrics.jsonl` and TensorBoard events; lines past the restored step are dropped."""

    def __init__(self, out: pathlib.Path, begin: int) -> None:
        self.path = out / "metrics.jsonl"
        old = files.read_text(self.path).splitlines() if self.path.exists() else []
        kept = [line for line in old if _step_of(line) <= begin]
        files.write_text(self.path, "".join(line + "\n" for line in kept))
        self.events = tensorboardX.SummaryWriter(str(out / "events"), purge_step=begin)

    def write(self, step: int, values: dict[str, float]) -> None:
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"step": step, **values}, allow_nan=False) + "\n")
            stream.flush()
            os.fsync(stream.fileno())  # before the step that it belongs to is saved
        for name, value in values.items():
            self.events.add_scalar(name, value, step)

    def last(self) -> dict[str, float]:
        lines = files.read_lines(self.path)
        return lines[-1] if lines else {}

    def close(self) -> None:
        self.events.close()
