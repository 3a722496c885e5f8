"""Learning of GN while it grasps: act greedily on several tables at once, learn from each outcome (as in the paper)."""

from __future__ import annotations

import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from flax import nnx

from dipn_jax import seeds, structs
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.networks.grasp import GraspNet, score_image
from dipn_jax.planning import candidates
from dipn_jax.seeds import Purpose
from dipn_jax.sight import render
from dipn_jax.storage import checkpoint, serialization
from dipn_jax.structs import Fault, Grasp, GraspEpisode, Scene
from dipn_jax.system import files
from dipn_jax.world import clutter
from dipn_jax.world.scenes import SceneConfig

from .. import finite
from ..configs import OnlineConfig
from ..grasp import SHIFT_PIXELS, WINDOW_PIXELS, Window, executed_loss, windows
from ..loop import make_step
from ..optimizers import constant_adamw
from . import tables
from .rounds import Run
from .tables import Tables

RECENT_GRASPS = 50
"""The number of last grasps over which success is counted."""


@serialization.register
@dataclasses.dataclass
class State:
    """Everything that an interrupted run needs to continue."""

    params: Any  # of the network
    moments: Any  # of the optimizer
    tables: Tables
    round: int = 0
    seen: list[Window] = dataclasses.field(default_factory=list)  # executed grasps, a batch for each round
    success: list[bool] = dataclasses.field(default_factory=list)  # in the order of the grasps


def learn(
    model: GraspNet, engine: Engine, scenes: SceneConfig, config: OnlineConfig, out: pathlib.Path
) -> dict[str, float]:
    """Learn online in the folder `out`; a run that was interrupted continues.

    Args:
      model: network to begin with; a compact one.
      engine: physics.
      scenes: distribution of fresh tables.
      config: how to learn.
      out: run folder: `config.json`, `metrics.jsonl` (one line a round), `checkpoints/`.

    Returns:
      Success over all grasps and over the last ones.

    Raises:
      UserError: the network is not compact, the folder holds another run, or a loss is not finite.
    """
    if model.config.preset != "compact":
        raise UserError(
            f"grasp-online: takes a compact network, got {model.config.preset}; that one learns from a data set, by "
            "dipn-train grasp"
        )
    identity = {"initial_weights": checkpoint.digest(model), **dataclasses.asdict(config), "scenes": str(scenes)}
    with Run(out, identity | {"engine": type(engine).__name__}) as run:
        ended = run.ended()
        if ended:
            return {name: ended[name] for name in ("success", "success_recent")}
        state = _play(run, model, engine, scenes, config)
        if not state.success:
            raise UserError(
                f"{out}: every simulation failed, so nothing was learnt; give another --engine or --objects"
            )
        nnx.update(model, jax.tree.map(jax.numpy.asarray, state.params))
        result = {
            "success": float(np.mean(state.success)),
            "success_recent": float(np.mean(state.success[-RECENT_GRASPS:])),
        }
        extra = {"seed": config.seed, "examples": len(state.success), **result}
        run.finish(model, len(state.success), network="grasp", config=model.config, extra=extra)
        return result


def _play(run: Run, model: GraspNet, engine: Engine, scenes: SceneConfig, config: OnlineConfig) -> State:
    """Grasp and learn to the end of the run."""
    graph, params, rest = nnx.split(model, nnx.Param, ...)  # type: ignore[misc]
    optimizer = constant_adamw(config)
    step = make_step(_Outcomes(), graph, optimizer)
    key = seeds.key(config.seed, Purpose.ONLINE_TRAINING)
    weights = jax.device_get(params)

    def fresh() -> State:
        purpose = Purpose.ONLINE_TABLES
        begun = tables.begin(engine, scenes, count=config.tables, seed=config.seed, purpose=purpose)
        return State(weights, jax.device_get(optimizer.init(weights)), begun)

    def act(state: State) -> str:
        _grasp(state, functools.partial(_best_grasps, graph, state.params, rest), engine, scenes)
        state.params, state.moments = _update(state, step, rest, config, jax.random.fold_in(key, state.round))
        return f"{np.mean(state.success[-RECENT_GRASPS:]):.2f} of the last {RECENT_GRASPS} held"

    log, total = functools.partial(_log, run.out, config), -(-config.grasps // config.tables)
    trees = {"params": weights, "moments": jax.eval_shape(optimizer.init, weights)}
    return run.play(fresh, act, total=total, what="grasp and learn", trees=trees, log=log)


class _Outcomes:
    """The part of a task that `make_step` needs."""

    def loss(self, model: nnx.Module, batch: Window, key: jax.Array) -> jax.Array:
        """Return the cross entropy of executed grasps."""
        return executed_loss(key, model, batch)


@functools.partial(jax.jit, static_argnums=0)
def _best_grasps(graph: Any, params: Any, rest: Any, scene: Scene, poses: jax.Array) -> Grasp:
    """Return the best grasp on each of the tables `[T]`."""
    network = nnx.merge(graph, params, rest)
    network.eval()

    def one(args: tuple[Scene, jax.Array]) -> Grasp:
        seen = render.render(*args)
        index, _ = candidates.best_grasp(score_image(network, render.rgbd(seen)))
        return candidates.grasp_at(index, seen.height)

    return jax.lax.map(one, (scene, poses))


def _grasp(state: State, best_grasps: Callable[..., Grasp], engine: Engine, scenes: SceneConfig) -> None:
    """Grasp once on every table, take away what is held, and replace tables that are empty or stuck."""
    before = state.tables
    taken = jax.device_get(best_grasps(before.scene, before.poses))
    scene, poses, held, fault = clutter.grasp_away(engine, before.scene, before.poses, taken)
    good = Fault.usable(fault)
    success = np.asarray(held.any(1))
    tried = GraspEpisode(
        scene=before.scene, poses=before.poses, after=poses, grasp=taken, held=held, success=success, fault=fault
    )
    if good.any():
        state.seen.append(windows(structs.take(tried, good), pixels=WINDOW_PIXELS["compact"] + 2 * SHIFT_PIXELS))
    state.success += [bool(one) for one in np.asarray(success)[good]]
    state.tables.step(scene, poses, success, good, engine, scenes)


def _update(state: State, step: Callable[..., Any], rest: Any, config: OnlineConfig, key: jax.Array) -> tuple[Any, Any]:
    """Take some optimizer steps on everything tried so far."""
    if not state.seen:
        return state.params, state.moments
    seen = structs.concatenate(state.seen)
    rng = np.random.default_rng([config.seed, state.round])
    params, moments = jax.tree.map(jax.numpy.array, (state.params, state.moments))
    drawn = [rng.integers(len(seen.target), size=config.batch) for _ in range(config.updates)]
    watch = finite.Watch(config.learning_rate, drawn.__getitem__, f"round {state.round} of learning")
    for k, index in enumerate(drawn):
        params, rest, moments, loss = step(
            params, jax.tree.map(jax.numpy.array, rest), moments, structs.take(seen, index), jax.random.fold_in(key, k)
        )
        watch.see(k, loss)
    watch.check(config.updates, (params, moments))
    return jax.device_get((params, moments))


def _log(out: pathlib.Path, config: OnlineConfig, state: State) -> None:
    """Write `metrics.jsonl`: the number of grasps after each round, and success over the last of them."""
    counts = range(config.tables, len(state.success) + 1, config.tables)
    rows = [{"step": n, "success": float(np.mean(state.success[max(0, n - RECENT_GRASPS) : n]))} for n in counts]
    lines = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    files.write_text(out / "metrics.jsonl", lines)
