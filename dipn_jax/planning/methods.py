"""The methods that clear tables: a registry of what each needs and how it is built. `load_policy` builds one.

A new method is an entry of `METHODS`, and its name one of `names.MethodName`, which the commands list without JAX.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int, Key

from dipn_jax.errors import UserError
from dipn_jax.names import Aid, MethodName
from dipn_jax.networks import vpg
from dipn_jax.planning import expected_misses, planner, predictors, scorers
from dipn_jax.planning.decide_functions import DecideFunction, decide_by_imagining, decide_by_values
from dipn_jax.planning.planner import Predictor, Rule, Scorer, ScoreSummary
from dipn_jax.planning.policy_config import DEFAULT_CONFIG, PolicyConfig
from dipn_jax.sight import observed
from dipn_jax.storage import checkpoint
from dipn_jax.structs import Array, Decision, Observation
from dipn_jax.system import forking

NetworkRole = Literal["push", "grasp", "value"]
"""What a network does in a method: predict pushes (DIPN), score grasps (GN), or value actions (compared methods)."""
ROLES: dict[NetworkRole, tuple[str, str]] = {
    "push": ("dipn", "push"),
    "grasp": ("grasp", "grasp"),
    "value": ("vpg", "baseline"),
}
"""What a network does in a method -> its name in checkpoints, and the dipn-train command that trains it."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """A method with its networks, ready to decide: observation in, decision out.

    `decide_function` is compiled once; policies that differ in rule or distances only share it (`with_config`).
    """

    decide_function: DecideFunction
    rule: Rule
    distances: Float[Array, " P"]  # metres, of the candidates

    def __call__(
        self, key: Key[Array, ""], observation: Observation, *, missed: Int[Array, "M 3"] = planner.NONE_MISSED
    ) -> Decision:
        """Decide on one table.

        Args:
          key: random key, for the candidates.
          observation: what the camera sees.
          missed: grasps (rotation, row, col) that missed on this table as it is, from `dipn_jax.MissedGrasps`.

        Raises:
          UserError: the observation is none of those that `dipn_jax.check_observation` lets through, all that lies on
            the table is below the gripper's reach, or this process was forked after JAX had been used.
        """
        if not observed.is_traced(observation):
            forking.check()
            observed.check_observation(observation)
            observed.require_graspable_height(observation)
        return self.decide_function(key, observation, missed, self.rule, self.distances)

    def with_config(self, config: PolicyConfig) -> Policy:
        """Return a policy of the same networks with another rule and other distances; as many candidates as before."""
        return dataclasses.replace(self, rule=config.rule(), distances=config.candidate_distances())


Runs = dict[str, pathlib.Path]
"""Role -> folder of a run."""


@dataclasses.dataclass(frozen=True)
class Method:
    """What a method is: the networks it needs and how its policy is built."""

    networks: tuple[NetworkRole, ...]  # that it decides with
    build: Callable[[Runs, PolicyConfig], Policy] | None  # None: it decides on the simulator's state, not on images
    about: str
    pushes: bool = True  # whether it ever pushes

    @property
    def needs_state(self) -> bool:
        """Whether it decides on the simulator's state, so that it is no policy of images."""
        return self.build is None


@dataclasses.dataclass(frozen=True)
class Networks:
    """The runs that a method takes its networks from, by role."""

    push: pathlib.Path | None = None  # dipn-train push
    grasp: pathlib.Path | None = None  # dipn-train grasp
    value: pathlib.Path | None = None  # dipn-train baseline

    def runs(self, method: str) -> Runs:
        """Return the runs that `method` needs.

        Raises:
          UserError: no such method, or one of its networks was not given.
        """
        needed = find(method).networks
        for role in needed:
            if getattr(self, role) is None:
                run = f"a run of dipn-train {ROLES[role][1]}{'' if role == 'value' else ', or builtin'}"
                raise UserError(f"--method {method}: needs --{role}-net (in Python {role}_net); give {run}")
        return {role: checkpoint.find(getattr(self, role), network=ROLES[role][0]) for role in needed}


def find(name: str) -> Method:
    """Return the method called `name`.

    Raises:
      UserError: there is none.
    """
    if name not in METHODS:
        raise UserError(f"--method {name}: want one of {', '.join(get_args(MethodName))}")
    return METHODS[name]


def load_policy(
    method: MethodName = "dipn+gn",
    *,
    push_net: pathlib.Path | str | None = "builtin",
    grasp_net: pathlib.Path | str | None = "builtin",
    value_net: pathlib.Path | str | None = None,
    config: PolicyConfig = DEFAULT_CONFIG,
) -> Policy:
    """Load the policy of a method, with the networks that come with the package or with your own.

    Example:
      policy = dipn_jax.load_policy("dipn+gn", push_net="runs/dipn")
      decision = policy(jax.random.key(0), observation)

    Args:
      method: a name of `METHODS`.
      push_net: run of `dipn-train push`, or `builtin`.
      grasp_net: run of `dipn-train grasp`, or `builtin`.
      value_net: run of `dipn-train baseline`; only the compared methods rea+dipn, dqn+gn and vpg need one.
      config: how it decides.

    Raises:
      UserError: no such method, a network that it needs was not given or is another, or it decides on the simulator's
        state (`physics+gn`).
    """
    paths = (None if run is None else pathlib.Path(run) for run in (push_net, grasp_net, value_net))
    if find(method).needs_state:
        raise UserError(f"--method {method}: decides on the simulator's state, not on an image; run dipn-eval clear")
    return build(find(method), Networks(*paths).runs(method), config)


def build(method: Method, runs: Runs, config: PolicyConfig) -> Policy:
    """Return the policy of a method that decides on images, with networks of given runs.

    Where all of them come with the package, policies with the same aids share what is compiled.
    """
    assert method.build is not None, "it needs the simulator's state"
    if not all(run.is_relative_to(checkpoint.SHIPPED) for run in runs.values()):
        return method.build(runs, config)
    shared = _of_shipped(method.build, tuple(runs.items()), config.released, config.aids)
    return shared.with_config(config) if method.pushes else shared


@functools.cache
def _of_shipped(
    build: Callable[[Runs, PolicyConfig], Policy],
    runs: tuple[tuple[str, pathlib.Path], ...],
    released: bool,
    aids: tuple[Aid, ...],
) -> Policy:
    return build(dict(runs), PolicyConfig(released=released, aids=aids))


def grasping_policy(scorer: Scorer, config: PolicyConfig = DEFAULT_CONFIG) -> Policy:
    """Return the policy that grasps where `scorer` is highest, and never pushes."""
    decide = decide_by_imagining(predictors.static_predictor, scorer, None)
    return Policy(decide, config.rule().replace(grasp_above=-1.0), np.array([0.1], np.float32))


def gn_scores(run: pathlib.Path, config: PolicyConfig) -> tuple[Scorer, ScoreSummary]:
    """Return the scorer that GN's grasps are chosen by, and the summary that images are compared by.

    The clauses of the released code need the highest score of every image, so images are then scored whole.
    """
    summary = scorers.load_summary(run, whole=config.released, table="table" in config.aids)
    return scorers.load_scorer(run, aids=config.aids), summary


def _predictor(runs: Runs, config: PolicyConfig) -> Predictor:
    return predictors.load_predictor(runs["push"], mirrors="mirrors" in config.aids)


def _dipn_gn(runs: Runs, config: PolicyConfig) -> Policy:
    decide = decide_by_imagining(_predictor(runs, config), *gn_scores(runs["grasp"], config))
    return Policy(decide, config.rule(), config.candidate_distances())


def _dipn_gn_actions(runs: Runs, config: PolicyConfig) -> Policy:
    scorer, summarize = gn_scores(runs["grasp"], config)
    estimate = expected_misses.misses_to_come(scorer)
    decide = decide_by_imagining(_predictor(runs, config), scorer, summarize, estimate=estimate)
    return Policy(decide, config.rule(), config.candidate_distances())


def _rea_dipn(runs: Runs, config: PolicyConfig) -> Policy:
    table = "table" in config.aids
    summary = scorers.load_summary(runs["value"], network="vpg", whole=config.released, table=table)
    decide = decide_by_imagining(_predictor(runs, config), _chances(runs["value"], config.aids), summary)
    return Policy(decide, config.rule(), config.candidate_distances())


def _dqn_gn(runs: Runs, config: PolicyConfig) -> Policy:
    scorer = scorers.load_scorer(runs["grasp"], aids=config.aids)
    network_scores = scorers.load_unaided_scorer(runs["grasp"], table="table" in config.aids)
    decide = decide_by_values(_part(runs["value"], "push"), scorer, network_scores, grasp_at_once=True)
    return Policy(decide, config.rule(), config.candidate_distances())


def _vpg(runs: Runs, config: PolicyConfig) -> Policy:
    pushes, grasps = _part(runs["value"], "push"), _part(runs["value"], "grasp", config.aids)
    table: tuple[Aid, ...] = ("table",) if "table" in config.aids else ()
    decide = decide_by_values(pushes, grasps, _part(runs["value"], "grasp", table), grasp_at_once=False)
    return Policy(decide, config.rule(), config.candidate_distances())


def _gn(runs: Runs, config: PolicyConfig) -> Policy:
    return grasping_policy(scorers.load_scorer(runs["grasp"], aids=config.aids), config)


def _chances(run: pathlib.Path, aids: tuple[Aid, ...]) -> Scorer:
    """Return the scorer of the grasps of REA.

    Raises:
      UserError: the run answers with values, of which neither a mean nor the threshold 0.7 has a meaning.
    """
    model: Any = checkpoint.load_network(run, network="vpg")
    if model.config.answers != "chance":
        raise UserError(
            f"--value-net {run}: predicts values, not chances; give a run of dipn-train baseline --method rea"
        )
    return _part(run, "grasp", aids)


def _part(run: pathlib.Path, name: str, aids: tuple[Aid, ...] = ()) -> Scorer:
    """Return the scorer of pushes or of grasps of a baseline.

    Raises:
      UserError: it was trained without.
    """
    if (found := scorers.load_values(run, aids=aids)[vpg.NETWORK_PARTS.index(name)]) is None:
        raise UserError(f"--value-net {run}: was not trained to {name}; give a run of another --method")
    return found


METHODS: dict[str, Method] = {
    "dipn+gn": Method(("push", "grasp"), _dipn_gn, "imagine every push with DIPN, compare GN's mean scores"),
    "dipn+gn+actions": Method(
        ("push", "grasp"), _dipn_gn_actions, "the same pushes, made where they save more than the action they cost"
    ),
    "gn": Method(("grasp",), _gn, "GN's best grasp, never a push", pushes=False),
    "dqn+gn": Method(("value", "grasp"), _dqn_gn, "GN for grasps, Q-learning for pushes"),
    "rea+dipn": Method(("push", "value"), _rea_dipn, "as dipn+gn, with REA's grasp network in place of GN"),
    "vpg": Method(("value",), _vpg, "two Q-functions, one of pushes and one of grasps"),
    "physics+gn": Method(("grasp",), None, "imagine every push with the engine itself, from the simulator's state"),
}
"""All methods by name."""
