"""The commands `dipn-eval clear` and `dipn-eval sweep`."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dipn_jax import console
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName, MethodName

from .. import options
from .tables import DEFAULT_TABLES, Tables

if TYPE_CHECKING:
    from dipn_jax.engine import Engine
    from dipn_jax.planning.methods import Networks, PolicyConfig
    from dipn_jax.storage import resume

    from .on_tables import TablePolicy

MAX_CANDIDATES = 4096
"""Largest number of pushes that may be considered at a time."""
SIMULATED_PUSH = 0.10
"""Metres: a shorter push is simulated until one of this length would have ended."""


def clear(
    out: pathlib.Path,
    method: MethodName = "dipn+gn",
    push_net: pathlib.Path | None = None,
    grasp_net: pathlib.Path | None = None,
    value_net: pathlib.Path | None = None,
    tables: Annotated[Tables, tyro.conf.arg(name="")] = DEFAULT_TABLES,
    candidates: int = 32,
    distance: float = 0.10,
    gamma: float = 0.9,
    threshold: float = 0.7,
    released: bool = False,
    cautious: bool = True,
    remember: bool = True,
    label: str = "",
    seed: int = 1_000_000,
    engine: EngineName = "auto",
    threads: int | None = None,
) -> None:
    """Clear tables: push or grasp, until nothing is left.

      dipn-eval clear --push-net builtin --grasp-net builtin --cases hard --instances 30 --out results/hard
      dipn-eval clear --push-net builtin --grasp-net builtin --cases random --objects 30 --instances 30 --out results/30

    The compared methods: gn (grasps only), physics+gn (the engine itself as predictor), and with networks of dipn-train
    baseline rea+dipn, dqn+gn and vpg:
      dipn-eval clear --method dqn+gn --value-net runs/dqn --grasp-net builtin --out results/dqn

    Args:
      out: folder for metrics.json and every step of every table.
      method: how to decide.
      push_net: run of dipn-train push, or builtin.
      grasp_net: run of dipn-train grasp, or builtin.
      value_net: run of dipn-train baseline.
      tables: the tables to clear.
      candidates: pushes considered at a time.
      distance: metres of a push.
      gamma: discount of a push's value.
      threshold: grasp at once above this score.
      released: add the clauses of DIPN's released code: a lone object is grasped, a push must raise the best
        score, gamma discounts only pushes after which that is over 0.5, and no object may come near the edge.
      cautious: GN's score of a grasp is the lowest of its scores of the grasp and of its mirror images, halved where
        a finger would land on something; no: as published. Means of imagined images are always as published.
      remember: halve the scores of grasps like one that missed until something near them moves; no: as published.
      label: for the report, what distinguishes this evaluation from others of its method, such as the data learnt from.
      seed: random seed of scenes, perturbations and candidates.
      engine: physics engine.
      threads: that native simulates on; one a core if not given.
    """
    settings = _settings(locals())
    from dipn_jax.physics import make_engine
    from dipn_jax.planning.methods import Networks, PolicyConfig

    from . import on_tables

    config = PolicyConfig(
        candidates=candidates,
        distances=(distance,),
        gamma=gamma,
        grasp_above=threshold,
        released=released,
        cautious=cautious,
    )
    _check(out, seed, config, tables)
    networks, physics = Networks(push_net, grasp_net, value_net), make_engine(engine, threads=threads)
    (decide,) = on_tables.load(method, networks, physics, [config])
    longest, runs = max(distance, SIMULATED_PUSH), networks.runs(method)
    _clear(out, decide, physics, tables, settings=settings, runs=runs, longest=longest, remember=remember)


def _settings(given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a command by name, those of its tables as `tables.NAME`."""
    tables: Tables = given["tables"]
    others = {key: value for key, value in options.settings(given).items() if key != "tables"}
    chosen = {f"tables.{key}": value for key, value in dataclasses.asdict(tables).items()}
    return others | chosen | ({} if tables.cases in ("hard", "random") else {"tables.cases": tables.path()})


def _check(out: pathlib.Path, seed: int, config: PolicyConfig, tables: Tables) -> None:
    """Refuse options that make no sense, and a case file that cannot be used."""
    from dipn_jax.planning.methods import LONGEST_PUSH

    options.check(out, seed, candidates=config.candidates)
    console.require_between(1, MAX_CANDIDATES, candidates=config.candidates)
    for distance in config.distances:
        console.require_between(0.01, LONGEST_PUSH, distance=distance)
    console.require_between(0.0, 10.0, gamma=config.gamma, threshold=config.grasp_above)
    tables.slots()  # reads the case file


def sweep(
    out: pathlib.Path,
    push_net: pathlib.Path,
    grasp_net: pathlib.Path,
    distances: str = "0.03:0.12:0.01",
    tables: Annotated[Tables, tyro.conf.arg(name="")] = DEFAULT_TABLES,
    candidates: int = 32,
    pushes: int = 200,
    gamma: float = 0.9,
    threshold: float = 0.7,
    seed: int = 1_000_000,
    engine: EngineName = "auto",
    threads: int | None = None,
) -> None:
    """Clear the same tables at one push distance after another, and with the policy that chooses the distance itself.

    Prediction error, completion and efficiency against distance:
      dipn-eval sweep --push-net builtin --grasp-net builtin --instances 10 --out results/sweep

    Args:
      out: folder for metrics.json and sweep.png, and in a folder for each distance what dipn-eval clear writes.
      push_net: run of dipn-train push, or builtin; beyond 10 cm objects continue as in the last centimetre.
      grasp_net: run of dipn-train grasp, or builtin.
      distances: first:last:step, metres, to 0.12.
      tables: the tables to clear.
      candidates: pushes considered at a time; the choosing policy gives each of them one of the distances.
      pushes: scenes of 1 to 7 objects, a push in each, for the prediction error; 0: do not measure it.
      gamma: discount of a push's value.
      threshold: grasp at once above this score.
      seed: random seed of scenes, perturbations and candidates.
      engine: physics engine.
      threads: that native simulates on; one a core if not given.
    """
    settings = _settings(locals()) | {"method": "dipn+gn", "label": ""}
    from dipn_jax.physics import make_engine
    from dipn_jax.planning.methods import Networks, PolicyConfig
    from dipn_jax.storage import resume

    from .. import metrics
    from . import sweeping

    every = sweeping.parse(distances)
    console.require_between(0, 100_000, pushes=pushes)
    if candidates < len(every):
        raise UserError(f"--candidates {candidates}: want at least one for each of the {len(every)} distances")
    chosen = PolicyConfig(candidates=candidates, distances=every, gamma=gamma, grasp_above=threshold)
    _check(out, seed, chosen, tables)
    configs = {sweeping.name(each): dataclasses.replace(chosen, distances=(each,)) for each in every}
    configs[sweeping.CHOSEN] = chosen
    networks, physics = Networks(push_net, grasp_net), make_engine(engine, threads=threads)
    kept = resume.Partial(out, settings, inputs=_inputs(networks.runs("dipn+gn"), tables))
    values = _clear_with_each(out, configs, networks, physics, tables, settings=settings, kept=kept)
    if pushes:
        values |= _prediction_errors(push_net, physics, every, scenes=pushes, seed=seed)
    sweeping.figure(values).savefig(out / "sweep.png", dpi=130)
    metrics.write(out, values, settings=options.recorded(settings, kept))
    kept.finish()
    console.say(f"{out / 'metrics.json'}: {len(values)} numbers")


def _clear_with_each(
    out: pathlib.Path,
    configs: dict[str, PolicyConfig],
    networks: Networks,
    physics: Engine,
    tables: Tables,
    *,
    settings: dict[str, Any],
    kept: resume.Partial,
) -> dict[str, Any]:
    """Clear the same tables with each of `configs`, in a folder of its name; continues where it was interrupted.

    Returns:
      All metrics, as `sweep/NAME/METRIC`.
    """
    from . import on_tables

    runs = networks.runs("dipn+gn")
    longest = max(max(config.distances) for config in configs.values())
    ended: dict[str, dict[str, Any]] = kept.load({})
    policies = on_tables.load("dipn+gn", networks, physics, list(configs.values()))
    for name, decide in zip(configs, policies, strict=True):
        if name not in ended:
            named = settings | {"label": name}
            ended[name] = _clear(out / name, decide, physics, tables, settings=named, runs=runs, longest=longest)
            kept.save(ended)
    return {f"sweep/{name}/{key}": value for name, found in ended.items() for key, value in found.items()}


def _prediction_errors(
    push_net: pathlib.Path, physics: Engine, distances: tuple[float, ...], *, scenes: int, seed: int
) -> dict[str, float]:
    """Measure the errors of predicted masks at each of `distances`: one push on each of `scenes` as published."""
    from dipn_jax.planning.predictors import load_predictor
    from dipn_jax.world.scenes import PAPER

    from . import sweeping

    predictor = load_predictor(push_net)
    return sweeping.prediction_errors(
        predictor, physics, PAPER, distances, scenes=scenes, seed=seed, longest=max(distances)
    )


def _inputs(runs: dict[str, pathlib.Path], tables: Tables) -> list[pathlib.Path]:
    """Return the runs and files that the results depend on, besides the options."""
    path = tables.path()
    return [*runs.values(), *([path] if path else [])]


def _clear(
    out: pathlib.Path,
    decide: TablePolicy,
    physics: Engine,
    tables: Tables,
    *,
    settings: dict[str, Any],
    runs: dict[str, pathlib.Path],
    longest: float,
    remember: bool = True,
) -> dict[str, Any]:
    """Clear tables and write the results; continues where it was interrupted.

    Args:
      out: folder of the results.
      decide: decides on every table.
      physics: physics engine.
      tables: the tables to clear.
      settings: options, for `settings.json`.
      runs: networks that `decide` uses.
      longest: metres of the longest push.
      remember: whether the scores of grasps like one that missed are halved.

    Returns:
      The metrics.
    """
    from dipn_jax.storage import resume

    from . import lockstep

    seed = settings["seed"]
    partial = resume.Partial(out, settings, inputs=_inputs(runs, tables))
    instances = tables.make(physics, seed=seed)
    ended = lockstep.clear(instances, physics, decide, partial, seed=seed, longest=longest, remember=remember)
    lockstep.save(ended, out)
    values = lockstep.summary(ended)
    options.finish(out, values, settings, partial)
    return values
