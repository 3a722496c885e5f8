"""Learning of the compared methods while they act: values or chances of pushes and grasps.

VPG and REA: Zeng et al., IROS 2018. DQN+GN: Huang et al., ICRA 2021, its push reward from their released code.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import seeds, structs
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.networks import losses
from dipn_jax.networks.vpg import VPG, VpgConfig
from dipn_jax.planning.planner import Scorer
from dipn_jax.seeds import Purpose
from dipn_jax.storage import checkpoint, serialization
from dipn_jax.structs import Grasp, GraspEpisode
from dipn_jax.system import files
from dipn_jax.world.scenes import SceneConfig

from .. import finite
from ..configs import BaselineConfig
from ..grasp import GRASP_MIRRORS, PUSH_MIRRORS, SHIFT_PIXELS, WINDOW_PIXELS, Window, executed, windows
from ..loop import make_step
from ..optimizers import constant_adamw
from . import acting, tables
from .acting import Look
from .rounds import Run

LEARNT_PARTS: dict[str, tuple[str, ...]] = {"vpg": ("push", "grasp"), "rea": ("grasp",), "dqn": ("push",)}
"""What each method learns: REA+DIPN uses REA's grasps only, DQN+GN has GN for its grasps."""
MIRRORS = {"push": PUSH_MIRRORS, "grasp": GRASP_MIRRORS}
"""Axes along which the images of a primitive may be mirrored."""
PUSH_DISTANCE = 0.10
"""Metres of a push."""
RECENT_ACTIONS = 100
"""The number of last actions over which rewards are averaged."""


@serialization.register
@dataclasses.dataclass
class State:
    """Everything that an interrupted run needs to continue."""

    params: Any
    rest: Any  # of the network: batch statistics
    moments: Any
    tables: tables.Tables
    then: Look | None = None  # of the tables after their last action, by the weights of that time
    anew: np.ndarray = dataclasses.field(
        default_factory=lambda: np.ones(0, bool)
    )  # [T]: tables that were replaced since
    round: int = 0
    seen: dict[str, list[Window]] = dataclasses.field(default_factory=lambda: {"push": [], "grasp": []})
    did: list[tuple[str, float]] = dataclasses.field(default_factory=list)  # primitive and reward of each action


class _Outcomes:
    """The part of a task that `make_step` needs: one batch of windows for each part of the network."""

    def __init__(self, answers: str) -> None:
        self.answers = answers

    def loss(self, model: nnx.Module, batch: dict[str, Window], key: jax.Array) -> jax.Array:
        """Return the Huber loss of values, or the cross entropy of chances, at executed pixels.

        Images are shifted, mirrored and recoloured as GN's are.
        """
        total = jnp.zeros(())
        for name, part_key in zip(batch, jax.random.split(key, len(batch)), strict=True):
            some = batch[name]
            out = executed(part_key, getattr(model, name), some, mirrors=MIRRORS[name])
            if self.answers == "chance":
                total += losses.score_loss(out, some.target, jnp.ones(len(out)))
            else:
                total += losses.smooth_l1(out - some.target).mean()
        return total


def learn(
    engine: Engine,
    scenes: SceneConfig,
    config: BaselineConfig,
    out: pathlib.Path,
    *,
    initial: VPG | None = None,
    scorer: Scorer | None = None,
    scored_by: str = "",
) -> dict[str, float]:
    """Learn in the folder `out`; a run that was interrupted continues.

    Args:
      engine: physics.
      scenes: distribution of fresh tables.
      config: how to learn.
      out: run folder: `config.json`, `metrics.jsonl` (one line a round), `checkpoints/`.
      initial: network to start from, whose architecture is used.
      scorer: GN, whose grasps `dqn` executes.
      scored_by: digest of its weights.

    Returns:
      Mean reward of all and of the last pushes and grasps.

    Raises:
      UserError: the folder holds another run, there is no scorer for `dqn`, `initial` is of another method, or a loss
        is not finite.
    """
    if (config.method == "dqn") != (scorer is not None):
        raise UserError(
            f"baseline: --method {config.method} takes {'a' if config.method == 'dqn' else 'no'} --grasp-net"
        )
    if initial is not None:
        config = dataclasses.replace(config, preset=initial.config.preset)  # type: ignore[arg-type]
    model: Any = _begun(config, initial)
    network = model.config
    with Run(out, _identity(engine, scenes, config, scored_by, initial)) as run:
        ended = run.ended()
        if ended:
            return {name: value for name, value in ended.items() if name.startswith("reward/")}
        state = _play(run, model, engine, scenes, config, scorer)
        nnx.update(model, jax.tree.map(jnp.asarray, state.params), jax.tree.map(jnp.asarray, state.rest))
        result = _rewards(state.did, len(state.did)) | {
            f"{k}/recent": v for k, v in _rewards(state.did, RECENT_ACTIONS).items()
        }
        extra = {"seed": config.seed, "method": config.method, "examples": len(state.did), **result}
        run.finish(model, len(state.did), network="vpg", config=network, extra=extra)
        return result


def _begun(config: BaselineConfig, initial: VPG | None) -> VPG:
    """Return the network to begin with: `initial`, which has to be of the method, or one with random weights."""
    fresh = VpgConfig(config.preset, LEARNT_PARTS[config.method], "chance" if config.method == "rea" else "value")
    if initial is None:
        return checkpoint.build("vpg", fresh, seed=config.seed)  # type: ignore[return-value]
    wanted, given = ((one.parts, one.answers) for one in (fresh, initial.config))
    if given != wanted:
        there, here = (f"{answers}s of {' and '.join(parts)}" for parts, answers in (given, wanted))
        raise UserError(
            f"--init: holds {there}, want {here} for --method {config.method}; give a run of that method, or none"
        )
    return nnx.clone(initial)


def _play(
    run: Run, model: VPG, engine: Engine, scenes: SceneConfig, config: BaselineConfig, scorer: Scorer | None
) -> State:
    """Act and learn to the end of the run."""
    graph, params, rest = nnx.split(model, nnx.Param, ...)  # type: ignore[misc]
    optimizer = constant_adamw(config)
    step = make_step(_Outcomes(model.config.answers), graph, optimizer)
    weights, statistics = jax.device_get((params, rest))

    def fresh() -> State:
        purpose = Purpose.BASELINE_TABLES
        begun = tables.begin(engine, scenes, count=config.tables, seed=config.seed, purpose=purpose)
        return State(weights, statistics, jax.device_get(optimizer.init(weights)), begun)

    def act(state: State) -> str:
        look = functools.partial(acting.look, graph, state.params, state.rest, scorer=scorer, distance=PUSH_DISTANCE)
        _act(state, look, engine, scenes, config)
        state.params, state.rest, state.moments = _update(state, step, config)
        return ", ".join(f"{name} {value:.2f}" for name, value in _rewards(state.did, RECENT_ACTIONS).items())

    total, log = -(-config.actions // config.tables), functools.partial(_log, run.out, config)
    trees = {"params": weights, "rest": statistics, "moments": jax.eval_shape(optimizer.init, weights)}
    return run.play(fresh, act, total=total, what=f"act and learn {config.method}", trees=trees, log=log)


def _identity(
    engine: Engine, scenes: SceneConfig, config: BaselineConfig, scored_by: str, initial: VPG | None
) -> dict[str, Any]:
    """Return everything that determines the run; runs without GN do not name one."""
    identity = {**dataclasses.asdict(config), "scenes": str(scenes), "engine": type(engine).__name__}
    identity["initial_weights"] = None if initial is None else checkpoint.digest(initial)
    return identity | ({"grasp_net": scored_by} if scored_by else {})


def _act(state: State, look: Callable[..., Look], engine: Engine, scenes: SceneConfig, config: BaselineConfig) -> None:
    """Act once on every table, and store the outcomes and their learning targets."""
    count, before = config.tables, state.tables
    anew = np.ones(count, bool) if state.then is None else state.anew
    now: Look = jax.device_get(look(before.scene, before.poses, anew))
    if state.then is not None:
        now = jax.tree.map(lambda a, b: np.where(anew.reshape(-1, *[1] * (a.ndim - 1)), a, b), now, state.then)
    rng = np.random.default_rng([config.seed, state.round])
    pushing = acting.choose(now, rng, len(state.did), may_push="push" in LEARNT_PARTS[config.method])
    scene, poses, held, good = acting.execute(engine, before.scene, before.poses, pushing, now.push, now.grasp)
    then: Look = jax.device_get(look(scene, poses, np.ones(count, bool)))
    changed = acting.changed(now, then)
    success = np.asarray(held.any(1))
    effect = np.where(pushing, changed, success)
    reward = np.where(pushing, acting.push_reward(now, then, method=config.method), success.astype(float))
    target = reward
    if config.method != "rea":
        target = acting.q_targets(reward, then, (scene.shape >= 0).any(1) & effect)
    for name, rows, centre, angle in (
        ("push", pushing & good, now.push.start, now.push.angle),
        ("grasp", ~pushing & good, now.grasp.center, now.grasp.angle),
    ):
        if name in LEARNT_PARTS[config.method] and rows.any():
            aim = Grasp(centre, angle, np.zeros(count, np.float32))
            tried = GraspEpisode(
                scene=before.scene,
                poses=before.poses,
                after=poses,
                grasp=aim,
                held=held,
                success=success,
                fault=np.zeros(count, int),
            )
            taught = windows(structs.take(tried, rows), pixels=WINDOW_PIXELS[config.preset] + 2 * SHIFT_PIXELS)
            state.seen[name].append(taught.replace(target=target.astype(np.float32)[rows]))
    state.did += [("push" if pushing[i] else "grasp", float(reward[i])) for i in np.flatnonzero(good)]
    state.anew, state.then = state.tables.step(scene, poses, effect, good, engine, scenes), then


def _update(state: State, step: Callable[..., Any], config: BaselineConfig) -> tuple[Any, Any, Any]:
    """Take some optimizer steps on everything tried so far."""
    parts = LEARNT_PARTS[config.method]
    if not all(state.seen[name] for name in parts):
        return state.params, state.rest, state.moments
    seen = {name: structs.concatenate(state.seen[name]) for name in parts}
    rng = np.random.default_rng([config.seed, state.round, 1])
    key = jax.random.fold_in(seeds.key(config.seed, Purpose.BASELINE_TRAINING), state.round)
    params, rest, moments = jax.tree.map(jnp.array, (state.params, state.rest, state.moments))
    drawn = [
        {n: rng.integers(len(some.target), size=config.batch) for n, some in seen.items()}
        for _ in range(config.updates)
    ]
    watch = finite.Watch(
        config.learning_rate, lambda k: np.concatenate(list(drawn[k].values())), f"round {state.round} of learning"
    )
    for k, index in enumerate(drawn):
        batch = {n: structs.take(some, index[n]) for n, some in seen.items()}
        params, rest, moments, loss = step(params, rest, moments, batch, jax.random.fold_in(key, k))
        watch.see(k, loss)
    watch.check(config.updates, (params, rest, moments))
    return jax.device_get((params, rest, moments))


def _rewards(did: list[tuple[str, float]], last: int) -> dict[str, float]:
    """Return the mean reward of the `last` actions, by primitive."""
    recent = did[-last:]
    result = {}
    for name in ("push", "grasp"):
        values = [reward for what, reward in recent if what == name]
        if values:
            result[f"reward/{name}"] = float(np.mean(values))
    return result


def _log(out: pathlib.Path, config: BaselineConfig, state: State) -> None:
    """Write `metrics.jsonl`: the number of actions after each round, and mean rewards of the last of them."""
    counts = range(config.tables, len(state.did) + 1, config.tables)
    rows = [{"step": n, **_rewards(state.did[:n], RECENT_ACTIONS)} for n in counts]
    lines = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    files.write_text(out / "metrics.jsonl", lines)
