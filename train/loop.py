"""The training loop, from top to bottom; the data, the loss and the network are given as a `Task`."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from dipn_jax import seeds
from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import checkpoint, owner, saving
from dipn_jax.system import files
from dipn_jax.system.interruption import Interruption

from . import devices, example_order, finite, log, precision, profiling
from .configs import DEFAULT_COMPUTE, Compute, TrainConfig, check
from .optimizers import make_optimizer
from .prefetch import Prefetcher

BEST_MEASURE = "held_out_loss"
"""Measure that is lowest at the best step of a run."""


class LossTask(Protocol):
    """Something with a loss; all that `make_step` needs of a task."""

    def loss(self, model: nnx.Module, batch: Any, key: jax.Array) -> jax.Array:
        """Return the loss of a batch of examples, inside jit."""
        ...


class Task(LossTask, Protocol):
    """Something to learn: data, a loss and a measure."""

    network: str  # key of checkpoint.NETWORKS
    network_config: Any
    size: int  # training examples
    parts: tuple[int, ...]  # training examples of each data set, in their order
    examples: int  # what a learning curve counts
    fingerprint: str  # of the data

    def fetch(self, index: np.ndarray) -> Any:
        """Return the examples `index [B]`.

        Raises:
          UserError: a shard that holds some of them cannot be read.
        """
        ...

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """Return measures on examples that are held out, BEST_MEASURE among them."""
        ...


def _split(model: nnx.Module) -> tuple[Any, Any, Any]:
    """Split a network into its graph, its parameters and everything else (statistics, random streams)."""
    parts: Any = nnx.split(model, nnx.Param, ...)
    return parts


def make_step(
    task: LossTask, graph: Any, optimizer: optax.GradientTransformation, *, compute: Compute = DEFAULT_COMPUTE
) -> Callable[..., Any]:
    """Return the jitted step `(params, rest, moments, batch, key) -> (params, rest, moments, loss)`.

    The first three arguments are donated.
    """

    def gradient(params: Any, rest: Any, batch: Any, key: jax.Array) -> tuple[jax.Array, Any, Any]:
        def loss(p: Any) -> tuple[jax.Array, Any]:
            model = nnx.merge(graph, p, rest, copy=True)  # variables of this trace, which may be written
            model.train()
            precision.compute_in(model, compute.precision)
            value = task.loss(model, batch, key)
            return value, _split(model)[2]

        (value, new_rest), slope = jax.value_and_grad(loss, has_aux=True)(params)
        return value, new_rest, slope

    @functools.partial(jax.jit, donate_argnums=(0, 1, 2))
    def step(params: Any, rest: Any, moments: Any, batch: Any, key: jax.Array) -> Any:
        if compute.accumulate == 1:
            value, rest, slope = gradient(params, rest, batch, key)
        else:
            value, rest, slope = _accumulated(functools.partial(gradient, params), rest, batch, key, compute.accumulate)
        updates, moments = optimizer.update(slope, moments, params)
        return optax.apply_updates(params, updates), rest, moments, value

    return step


def _accumulated(gradient: Callable[..., Any], rest: Any, batch: Any, key: jax.Array, parts: int) -> Any:
    """Return what `gradient(rest, batch, key)` does, as means over parts of the batch that are computed in turn.

    A part has every `parts`-th example, so that devices that share the batch share each part.
    """
    split = jax.tree.map(lambda leaf: leaf.reshape(-1, parts, *leaf.shape[1:]).swapaxes(0, 1), batch)

    def one(carry: Any, given: tuple[Any, jax.Array]) -> tuple[Any, None]:
        value, rest, slope = gradient(carry[1], *given)
        both = jax.tree.map(lambda total, part: total + part / parts, (carry[0], carry[2]), (value, slope))
        return (both[0], rest, both[1]), None

    first = jax.tree.map(lambda leaf: leaf[0], split)
    shapes = jax.eval_shape(gradient, rest, first, key)
    value, slope = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), (shapes[0], shapes[2]))
    return jax.lax.scan(one, (value, rest, slope), (split, jax.random.split(key, parts)))[0]


def fit(
    task: Task,
    config: TrainConfig,
    out: pathlib.Path,
    *,
    initial: nnx.Module | None = None,
    compute: Compute = DEFAULT_COMPUTE,
) -> dict[str, float]:
    """Train, or continue to train, in the folder `out`.

    Args:
      task: what to learn.
      config: how.
      out: run folder: `config.json`, `metrics.jsonl`, `events/` (TensorBoard), `checkpoints/` with the last two steps
        and the best.
      initial: network to start from; a fresh one if not given.
      compute: how steps are computed. Several processes call this with the same arguments; one of them writes.

    Returns:
      The last evaluation; with `compute.compile_only` the memory that a step needs, in MB; with `compute.check_only`
      nothing.

    Raises:
      UserError: the folder holds a run of another config or on other data, or another process has it; or a loss or
        a weight is not finite, after which nothing is saved.
    """
    check(config, compute, out, data_sets=len(task.parts))
    example_order.batches(task.parts, config)  # raises where the mix is wrong, before anything is made
    where = devices.placement(compute, batch=config.batch)
    optimizer = make_optimizer(config, examples=task.size)
    if compute.check_only:
        _claim(out, _identity(task, config, compute, initial), config, write=False)
        console.note(f"train {task.network}: {example_order.passes(task.size, config)}")
        return {}
    if compute.compile_only:
        return _compile(task, config, optimizer, initial, compute, where)
    with owner.owned(out) if where.leads else contextlib.nullcontext():
        return _fit(task, config, out, optimizer, initial, compute, where)


def _fit(
    task: Task,
    config: TrainConfig,
    out: pathlib.Path,
    optimizer: optax.GradientTransformation,
    initial: nnx.Module | None,
    compute: Compute,
    where: devices.OneDevice,
) -> dict[str, float]:
    """Train in a folder that this process owns, or its leader; arguments as of `fit`."""
    model = initial or checkpoint.build(task.network, task.network_config, seed=config.seed)
    identity = _identity(task, config, compute, initial)
    where.require_alike(identity, what="options, or folders of data")
    if where.leads:
        _claim(out, identity, config)
        console.note(f"train {task.network}: {example_order.passes(task.size, config)}")
    where.wait("claimed")
    moments, begin, best = _resume(out, model, optimizer)
    where.require_alike({"step": begin}, what="the step to continue at; is --out one folder for all?")
    graph, *state = _split(model)
    params, rest, moments = where.replicate((*state, moments))
    batches = example_order.batches(task.parts, config)
    step_fn = make_step(task, graph, optimizer, compute=compute)
    curve = log.Log(out, begin, batch=config.batch, writes=where.leads)
    key = seeds.key(config.seed, seeds.Purpose.TRAINING)
    latest, speed = dict[str, float](), ""
    watch = finite.Watch(config.learning_rate, lambda k: np.asarray(batches[k]), "the last finite checkpoint is kept")

    def save(step: int) -> None:
        here = where.local_copy((params, rest))
        parts = {"model": nnx.state(nnx.merge(graph, *here)), "train": where.local_copy(moments)}
        about = {"seed": config.seed, "data": task.fingerprint, "examples": task.examples, **latest, **best}
        if where.leads:
            saver.save(step, parts, extra=about)

    step, saver = begin, saving.Saver(out, network=task.network, config=task.network_config)
    ahead = Prefetcher(lambda k: task.fetch(where.rows(np.asarray(batches[k]))), begin, config.steps)
    progress = console.Progress(f"train {task.network}", config.steps, unit="steps", done=begin, quiet=not where.leads)
    profiled = profiling.Profiler(compute.profile if where.leads else None, begin)
    with progress, Interruption() as interruption, saver, profiled, ahead:
        while step < config.steps:
            profiled.see(step)
            batch = where.shard_batch(ahead.take())
            params, rest, moments, loss = step_fn(params, rest, moments, batch, jax.random.fold_in(key, step))
            watch.see(step, where.local_copy(loss))
            step += 1
            if step == begin + 1:
                curve.resume(step)  # it has been compiled
            stopping = where.any_process_stops(interruption.requested, step)
            evaluating = step % config.eval_every == 0 or step == config.steps
            due = step % config.save_every == 0 or step == config.steps or stopping
            if evaluating or due:
                watch.check(step, where.local_copy((params, rest, moments)))
                curve.pause(step)
            if evaluating:
                model = nnx.merge(graph, *where.local_copy((params, rest)))
                model.eval()
                latest = {"loss": float(where.local_copy(loss)), **task.evaluate(model)}
                watch.check(step, where.local_copy(params), **latest)
                speed = curve.write(step, latest)
                if not best or latest[BEST_MEASURE] < best["best"]["value"]:
                    best, due = {"best": {"step": step, "measure": BEST_MEASURE, "value": latest[BEST_MEASURE]}}, True
            if due:
                save(step)
            if stopping:
                saver.wait()
                raise KeyboardInterrupt
            if evaluating or due:
                curve.resume(step)
            progress.advance(1, " ".join([*(f"{k} {v:.3f}" for k, v in latest.items()), speed]))
    where.wait("done")
    curve.close()
    return latest or log.last(out)


def _compile(
    task: Task,
    config: TrainConfig,
    optimizer: optax.GradientTransformation,
    initial: nnx.Module | None,
    compute: Compute,
    where: devices.OneDevice,
) -> dict[str, float]:
    """Compile a step and return the memory in MB that XLA plans on each device; arguments as of `fit`."""
    graph, *state = _split(initial or checkpoint.build(task.network, task.network_config, seed=config.seed))
    given = where.replicate((*state, optimizer.init(state[0])))
    batch = where.shard_batch(task.fetch(where.rows(np.arange(config.batch) % task.size)))
    step: Any = make_step(task, graph, optimizer, compute=compute)
    planned = step.lower(*given, batch, jax.random.key(0)).compile().memory_analysis()
    sizes = {"arguments": planned.argument_size_in_bytes, "temporary": planned.temp_size_in_bytes}
    return {f"{name}_mb": size / 1e6 for name, size in sizes.items()}


def _resume(
    out: pathlib.Path, model: nnx.Module, optimizer: optax.GradientTransformation
) -> tuple[Any, int, dict[str, Any]]:
    """Return the optimizer's state, the step to begin with, and the best step so far as metadata of a step have it.

    Earlier weights of the run are put into `model`.
    """
    moments = optimizer.init(_split(model)[1])
    found = checkpoint.newest(out)
    if found is None:
        return moments, 0, {}
    folder, meta = found
    nnx.update(model, checkpoint.restore(folder, "model", nnx.state(model)))
    best = {"best": meta["best"]} if "best" in meta else {}
    return checkpoint.restore(folder, "train", moments), int(meta["step"]), best


def _identity(task: Task, config: TrainConfig, compute: Compute, initial: nnx.Module | None) -> dict[str, Any]:
    """Return everything that determines the run; a flat dictionary, so that a difference can be named."""
    learnt = {name: getattr(compute, name) for name in ("accumulate", "precision")}
    unusual = {name: value for name, value in learnt.items() if value != getattr(DEFAULT_COMPUTE, name)}
    how = dataclasses.asdict(config)
    if not how["mix"]:
        del how["mix"]
    start = None if initial is None else checkpoint.digest(initial)
    network = {f"network.{k}": v for k, v in dataclasses.asdict(task.network_config).items()}
    data = {"network": task.network, "initial_weights": start, "data": task.fingerprint}
    return {**data, **network, **how, **unusual}


def _claim(out: pathlib.Path, identity: dict[str, Any], config: TrainConfig, *, write: bool = True) -> None:
    """Claim the folder, or if not `write` only check that it can be; a rate that is constant allows more steps.

    Raises:
      UserError: the folder holds another run, or one whose rate has fallen for another number of steps.
    """
    if config.optimizer == "sgd":
        return files.claim(out, identity, free=("steps",), write=write)
    path = out / "config.json"
    begun = files.read_json(path).get("steps", config.steps) if path.exists() else config.steps
    files.claim(out, identity | {"steps": begun}, write=write)
    if begun != config.steps:
        raise UserError(
            f"{out}: its learning rate is planned for --steps {begun}, so that it cannot continue to {config.steps}; "
            f"give --init {out} and another --out to train on, or --optimizer sgd (a constant rate) from the start"
        )
