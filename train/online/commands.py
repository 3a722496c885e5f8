"""The commands `dipn-train grasp-online` and `baseline`, which learn while they act. Importing this imports no JAX."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

from dipn_jax.commands import console
from dipn_jax.names import EngineName
from dipn_jax.world.ranges import DEFAULT_RANGES, Objects, Ranges

from ..configs import LARGEST_BATCH, BaselineConfig, OnlineConfig, check_out

GRASP_ONLINE = OnlineConfig()
"""Defaults of `dipn-train grasp-online`."""
BASELINE = BaselineConfig()
"""Defaults of `dipn-train baseline`."""


def say(out: pathlib.Path, result: dict[str, float], *, digits: str) -> None:
    """Print the results of a run on one line."""
    console.say(f"{out}: " + ", ".join(f"{name} {value:{digits}}" for name, value in result.items()))


def grasp_online(
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    objects: Objects = "10",
    engine: EngineName = "auto",
    threads: int | None = None,
    ranges: Ranges = DEFAULT_RANGES,
    config: OnlineConfig = GRASP_ONLINE,
) -> None:
    """Train GN while it grasps: the best grasp on each of several tables, then some steps on all outcomes so far.

    Two minutes on two cores:
      dipn-train grasp-online --init runs/gn-pretrained --out runs/gn-online

    Args:
      out: run folder; the same command continues where it stopped.
      init: run to start from (grasp-pretrain's), or builtin; without it the compact network has random weights.
      objects: number of objects on a fresh table.
      engine: physics engine.
      threads: threads of the native engine; one per core by default.
      ranges: the ranges that random objects are drawn from.
      config: amount and schedule of learning.
    """
    console.require_positive(grasps=config.grasps)
    _check(out, config)
    from dipn_jax.networks.grasp import GraspConfig
    from dipn_jax.physics import make_engine
    from dipn_jax.storage import checkpoint
    from dipn_jax.world import scenes

    from . import grasping as online

    model: Any
    if init:
        model = checkpoint.load_network(init, network="grasp")
    else:
        model = checkpoint.build("grasp", GraspConfig(), seed=config.seed)
    config = dataclasses.replace(config, pretrained=init is not None)
    tables = scenes.parse_objects(objects, ranges=ranges)
    result = online.learn(model, make_engine(engine, threads=threads), tables, config, out)
    say(out, result, digits=".3f")


def baseline(
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    grasp_net: pathlib.Path | None = None,
    objects: Objects = "10",
    engine: EngineName = "auto",
    threads: int | None = None,
    ranges: Ranges = DEFAULT_RANGES,
    config: BaselineConfig = BASELINE,
) -> None:
    """Train a compared method while it acts: VPG, the grasps of its reactive form (REA), or DQN's pushes beside GN.

    Only vpg and dqn explore, by drawing push or grasp at random. With the samples that the paper gives them, 10 to 40
    minutes each on two cores:
      dipn-train baseline --method vpg --actions 2500 --out runs/vpg
      dipn-train baseline --method rea --actions 1500 --out runs/rea
      dipn-train baseline --method dqn --actions 1500 --grasp-net runs/gn --out runs/dqn

    Args:
      out: run folder; the same command continues where it stopped.
      init: run of the same method to start from; its architecture is used.
      grasp_net: run of dipn-train grasp or grasp-online, or builtin, whose grasps dqn takes.
      objects: number of objects on a fresh table.
      engine: physics engine.
      threads: threads of the native engine; one per core by default.
      ranges: the ranges that random objects are drawn from.
      config: method, and amount and schedule of learning.
    """
    console.require_positive(actions=config.actions)
    _check(out, config)
    from dipn_jax.physics import make_engine
    from dipn_jax.planning import scorers
    from dipn_jax.storage import checkpoint
    from dipn_jax.world import scenes

    from . import baseline as baselines

    initial: Any = checkpoint.load_network(init, network="vpg") if init else None
    gn: Any = checkpoint.load_network(grasp_net, network="grasp") if grasp_net else None
    result = baselines.learn(
        make_engine(engine, threads=threads),
        scenes.parse_objects(objects, ranges=ranges),
        config,
        out,
        initial=initial,
        scorer=scorers.unaided_scorer(gn) if gn else None,
        scored_by=checkpoint.digest(gn) if gn else "",
    )
    say(out, result, digits=".3f")


def _check(out: pathlib.Path, config: OnlineConfig | BaselineConfig) -> None:
    """Raise a UserError for options of learning while acting that make no sense, or an unusable `out`."""
    console.require_positive(updates=config.updates)
    console.require_between(1, LARGEST_BATCH, tables=config.tables, batch=config.batch)
    console.require_positive(learning_rate=config.learning_rate)
    console.require_between(0, 1, weight_decay=config.weight_decay)
    console.require_seed(config.seed)
    check_out(out)
