"""Push or grasp: every compared method, on many tables in one call."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax import batching
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.networks import vpg
from dipn_jax.planning import planner, policy
from dipn_jax.planning.planner import Rule
from dipn_jax.sight import render
from dipn_jax.storage import checkpoint
from dipn_jax.structs import Array, Decision, Observation, Scene

from . import choices, rollouts
from .choices import Choice

MethodName = Literal["dipn+gn", "rea+dipn", "dqn+gn", "vpg", "gn", "physics+gn"]
LONGEST = 0.12
"""Metres of a push at most."""
UNIMAGINED = ("vpg", "dqn+gn")
"""Methods that compare values of pushes and grasps, and imagine nothing."""
WANTED = {
    "dipn+gn": ("push", "grasp"),
    "rea+dipn": ("push", "value"),
    "dqn+gn": ("value", "grasp"),
    "vpg": ("value",),
    "gn": ("grasp",),
    "physics+gn": ("grasp",),
}
"""The networks that each method decides with."""
NETWORKS = {"push": "dipn", "grasp": "grasp", "value": "vpg"}
COMMANDS = {"push": "push", "grasp": "grasp", "value": "baseline"}


@dataclasses.dataclass(frozen=True)
class Plan:
    """How to decide."""

    method: MethodName = "dipn+gn"
    candidates: int = 32
    distances: tuple[float, ...] = (0.10,)  # metres a push goes; of several, candidates take them in turn
    gamma: float = 0.9
    threshold: float = 0.7
    released: bool = False  # with the clauses of DIPN's released code
    cautious: bool = True  # GN's scores are the least of four answers; False: GN as published
    remember: bool = True  # grasps like one that missed are doubted until something near moves

    def __post_init__(self) -> None:
        if self.method not in get_args(MethodName):
            raise UserError(f"--method {self.method}: want one of {', '.join(get_args(MethodName))}")

    def rule(self) -> Rule:
        """What the planner compares by."""
        rule = planner.RELEASED if self.released else Rule()
        result: Rule = rule.replace(gamma=self.gamma, threshold=self.threshold)
        return result

    def spread(self) -> np.ndarray:
        """The distance of each candidate `[P]`, metres."""
        return np.resize(np.asarray(self.distances, np.float32), self.candidates)


@dataclasses.dataclass(frozen=True)
class Nets:
    """Runs that a method decides with."""

    push: pathlib.Path | None = None  # dipn-train push
    grasp: pathlib.Path | None = None  # dipn-train grasp
    value: pathlib.Path | None = None  # dipn-train baseline

    def require(self, method: str) -> dict[str, pathlib.Path]:
        """The runs that `method` needs, by name.

        Raises:
          UserError: one was not given.
        """
        for name in WANTED[method]:
            if getattr(self, name) is None:
                raise UserError(f"--method {method}: wants --{name}-net; give a run of dipn-train {COMMANDS[name]}")
        return {name: checkpoint.find(getattr(self, name), network=NETWORKS[name]) for name in WANTED[method]}


Decide = Callable[[jax.Array, Observation, jax.Array, jax.Array, Rule], Decision]
"""(key, observation, grasps that missed [M, 3], distances [P] metres, rule) -> decision; jitted, one table."""
Decider = Callable[[jax.Array, Scene, Array, Array], Choice]
"""(keys [B], scenes [B, N], poses [B, N, 7], grasps that missed [B, M, 3]) -> choices [B], numpy."""


def load(plan: Plan, nets: Nets, engine: Engine, *, slots: int) -> Decider:
    """The decider of a method.

    Args:
      plan: method and rule.
      nets: runs.
      engine: physics, for `physics+gn`.
      slots: N.

    Raises:
      UserError: a network that the method needs was not given, or is another.
    """
    return load_each([plan], nets, engine, slots=slots)[0]


def load_each(plans: list[Plan], nets: Nets, engine: Engine, *, slots: int) -> list[Decider]:
    """Deciders of plans that differ in their distances and their rule: one compiled program. Arguments as of `load`."""
    plan = plans[0]
    runs = nets.require(plan.method)
    if plan.method == "gn":
        grasp = best_grasp(policy.load_scorer(runs["grasp"], cautious=plan.cautious), slots=slots)
        return [_minding(each, grasp) for each in plans]
    made: Callable[..., Choice]
    if plan.method == "physics+gn":
        scorer, appraise = _gn(plan, runs["grasp"])
        made = functools.partial(rollouts.decide, scorer, appraise, engine)
    else:
        made = functools.partial(_in_lockstep, _decide(plan, runs, slots))
    return [_minding(each, functools.partial(made, each.rule(), each.spread())) for each in plans]


def _gn(plan: Plan, run: pathlib.Path) -> tuple[planner.Scorer, planner.Appraiser]:
    """What grasps GN takes, and what it thinks of images.

    The clauses of the released code look at the best score on every image, which the fast way does not tell.
    """
    return policy.load_scorer(run, cautious=plan.cautious), policy.load_appraiser(run, whole=plan.released)


def _minding(plan: Plan, decide: Decider) -> Decider:
    """`decide`, told of no grasp that missed where the plan is not to remember any."""

    def forget(keys: jax.Array, scene: Scene, poses: Array, missed: Array) -> Choice:
        return decide(keys, scene, poses, np.broadcast_to(planner.NONE_MISSED[0], np.shape(missed)))

    return decide if plan.remember else forget


def best_grasp(scorer: planner.Scorer, *, slots: int) -> Decider:
    """The decider that grasps where `scorer` scores highest, and never pushes."""
    predictor = policy.static_predictor(slots)

    def decide(key: jax.Array, seen: Observation, missed: jax.Array, distances: jax.Array, rule: Rule) -> Decision:
        options: dict[str, Any] = {"count": len(distances), "slots": slots, "distance": distances, "rule": rule}
        return planner.decide(key, seen, predictor, scorer, missed=missed, **options)

    return functools.partial(_in_lockstep, decide, Rule(threshold=-1.0), np.array([0.1], np.float32))


def _decide(plan: Plan, runs: dict[str, pathlib.Path], slots: int) -> Decide:
    """One table's decision as a function of key, observation, distances and rule."""
    if plan.method in UNIMAGINED:
        return _compare(plan, runs, slots)
    predictor = policy.load_predictor(runs["push"], slots)
    if plan.method == "rea+dipn":
        scorer, appraise = (
            _chances(runs["value"]),
            policy.load_appraiser(runs["value"], network="vpg", whole=plan.released),
        )
    else:
        scorer, appraise = _gn(plan, runs["grasp"])

    def imagine(key: jax.Array, seen: Observation, missed: jax.Array, distances: jax.Array, rule: Rule) -> Decision:
        options: dict[str, Any] = {"count": plan.candidates, "slots": slots, "distance": distances, "rule": rule}
        return planner.decide(key, seen, predictor, scorer, appraise=appraise, missed=missed, **options)

    return imagine


def _compare(plan: Plan, runs: dict[str, pathlib.Path], slots: int) -> Decide:
    """As `_decide`, of a method that imagines nothing."""
    pushes = _part(runs["value"], "push")
    with_gn = plan.method == "dqn+gn"
    scorer = policy.load_scorer(runs["grasp"], cautious=plan.cautious) if with_gn else _part(runs["value"], "grasp")

    def compare(_: jax.Array, seen: Observation, missed: jax.Array, distances: jax.Array, rule: Rule) -> Decision:
        threshold = rule.threshold if with_gn else jnp.inf
        options: dict[str, Any] = {"slots": slots, "distance": distances[0], "threshold": threshold, "missed": missed}
        return planner.compare(seen, pushes, scorer, **options)

    return compare


def _chances(run: pathlib.Path) -> planner.Scorer:
    """The scorer of the grasps of REA.

    Raises:
      UserError: the run answers with values: means of them, and 0.7, would mean nothing.
    """
    model: Any = checkpoint.load_network(run, network="vpg")
    if model.config.answers != "chance":
        raise UserError(
            f"--value-net {run}: has learnt values, not chances; give a run of dipn-train baseline --method rea"
        )
    return _part(run, "grasp")


def _part(run: pathlib.Path, name: str) -> planner.Scorer:
    """The scorer of pushes or of grasps of a baseline.

    Raises:
      UserError: it was trained without.
    """
    found = policy.load_values(run)[vpg.PARTS.index(name)]
    if found is None:
        raise UserError(
            f"--value-net {run}: has not learnt to {name}; give a run of another dipn-train baseline --method"
        )
    return found


def _in_lockstep(
    decide: Decide, rule: Rule, distances: np.ndarray, keys: jax.Array, scene: Scene, poses: Array, missed: Array
) -> Choice:
    """`decide` on all tables `[B]`."""
    choose: Choice = batching.in_small_batches(
        functools.partial(_choices, decide=decide, rule=rule, distances=distances), keys, scene, poses, missed
    )
    return choose


@functools.partial(jax.jit, static_argnames="decide")
def _choices(
    keys: jax.Array,
    scene: Scene,
    poses: jax.Array,
    missed: jax.Array,
    real: jax.Array,
    *,
    decide: Decide,
    rule: Rule,
    distances: jax.Array,
) -> Choice:
    """Choices of the tables that are real, one after another: a decision is itself a batch of images."""

    def one(key: jax.Array, scene: Scene, poses: jax.Array, missed: jax.Array) -> Choice:
        seen = render.render(scene, poses)
        return choices.choice(seen, decide(key, seen, missed, distances, rule))

    def some(args: tuple[jax.Array, Scene, jax.Array, jax.Array, jax.Array]) -> Choice:
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, *args[:4]))
        return jax.lax.cond(args[4], lambda: one(*args[:4]), lambda: nothing)

    return jax.lax.map(some, (keys, scene, poses, missed, real))
