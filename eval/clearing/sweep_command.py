"""The command `dipn-eval sweep`."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dipn_jax.commands import command_line, console
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError
from dipn_jax.names import ALL_AIDS, Aid, EngineName

from .. import options
from ..workers import shares
from ..workers.shares import WHOLE, Share
from . import evaluation
from .camera import DEFAULT_CAMERA, Camera
from .tables import DEFAULT_TABLES, Tables

if TYPE_CHECKING:
    import numpy as np

    from dipn_jax.engine import Engine
    from dipn_jax.planning.methods import Networks
    from dipn_jax.planning.policy_config import PolicyConfig
    from dipn_jax.storage import resume


def sweep(
    out: pathlib.Path,
    push_net: pathlib.Path,
    grasp_net: pathlib.Path,
    distances: str = "0.03:0.12:0.01",
    tables: Annotated[Tables, tyro.conf.arg(name="")] = DEFAULT_TABLES,
    camera: Annotated[Camera, tyro.conf.arg(name="")] = DEFAULT_CAMERA,
    candidates: int = 32,
    pushes: int = 200,
    gamma: float = 0.9,
    threshold: float = 0.7,
    aids: tuple[Aid, ...] = ALL_AIDS,
    seed: int = 1_000_000,
    engine: EngineName = "auto",
    threads: int | None = None,
    share: Annotated[Share, tyro.conf.arg(name="")] = WHOLE,
    launch: Annotated[Launch, tyro.conf.arg(name="")] = LOCAL,
) -> None:
    """Clear the same tables at one push distance after another, and with the policy that chooses the distance itself.

    Prediction error, completion and efficiency against distance:
      dipn-eval sweep --push-net builtin --grasp-net builtin --instances 10 --out results/sweep

    A quarter of the tables at every distance, as one of four workers, for dipn-eval merge:
      dipn-eval sweep --push-net builtin --grasp-net builtin --instances 10 --shard 0 --of 4 --out results/part-0

    Args:
      out: folder for metrics.json and sweep.png, and in a folder for each distance what dipn-eval clear writes.
      push_net: run of dipn-train push, or builtin; beyond 10 cm objects continue as in the last centimetre.
      grasp_net: run of dipn-train grasp, or builtin.
      distances: first:last:step, metres, to 0.12.
      tables: the tables to clear.
      camera: what the policy sees.
      candidates: pushes considered at a time; the choosing policy gives each of them one of the distances.
      pushes: scenes of 1 to 7 objects, a push in each, for the prediction error; 0: do not measure it.
      gamma: factor of a push's value, 0 to 1.
      threshold: score, 0 to 1, above which the best grasp is made at once.
      aids: small rules of ours that are in no paper, as of dipn-eval clear.
      seed: random seed of scenes, perturbations and candidates.
      engine: physics engine.
      threads: threads of the native engine; one per core by default.
      share: which part of the tables, and of the scenes of --pushes, this worker takes.
      launch: where tables are cleared; as tasks, all shards are made and put together.
    """
    asked = dict(locals())
    given = evaluation.settings(asked) | {"method": "dipn+gn", "label": ""}
    from dipn_jax.physics import grouped, make_engine
    from dipn_jax.planning.methods import Networks
    from dipn_jax.planning.policy_config import PolicyConfig
    from dipn_jax.storage import owner, resume

    from .. import metrics
    from ..workers import launching
    from . import sweep_merging, sweeping

    every = sweeping.parse(distances)
    console.require_between(0, 100_000, pushes=pushes)
    evaluation.check(out, seed, tables, candidates=candidates, distances=every, gamma=gamma, threshold=threshold)
    chosen = PolicyConfig(candidates=candidates, distances=every, gamma=gamma, grasp_above=threshold, aids=aids)
    share.check(launch)
    launch.begin()
    if pushes and share.of > pushes:
        raise UserError(f"--of {share.of}: more workers than --pushes {pushes}; want at most {pushes}, or --pushes 0")
    configs = {sweeping.name(each): dataclasses.replace(chosen, distances=(each,)) for each in every}
    configs[sweeping.CHOSEN] = chosen
    networks = Networks(push_net, grasp_net)
    physics = grouped.group_by_object_count(make_engine(engine, threads=threads))
    inputs = evaluation.inputs(networks.runs("dipn+gn"), tables)
    kept = resume.Partial(out, given, inputs=inputs, part=share.number_and_count())
    if launch.uses_cluster:
        launching.evaluate("sweep", asked, kept, total=tables.count())
        return
    command = command_line.words(sweep, asked, without=command_line.WORKER_OPTIONS)
    with owner.owned(out):
        if shares.is_made(out, "sweep", share, kept):
            return
        clear = functools.partial(evaluation.clear, share=share, kind="sweep", command=command)
        values = _clear_with_each(clear, out, configs, networks, physics, tables, camera, given=given, kept=kept)
        errors = _errors(push_net, physics, every, scenes=pushes, seed=seed, share=share) if pushes else None
        if not share.whole:
            names = sweep_merging.save(out, list(configs), errors)
            shares.write(
                out,
                "sweep",
                share,
                total=shares.read(out / sweeping.CHOSEN).total,
                command=command,
                given=given,
                partial=kept,
                names=names,
                about={"names": list(configs), "errors": errors is not None},
            )
            return
        values = sweep_merging.finish(out, values, errors, list(configs))
        metrics.write(out, values, settings=options.recorded(given, kept))
        kept.finish()
    console.say(f"{out / 'metrics.json'}: {len(values)} numbers")


def _clear_with_each(
    clear: Callable[..., dict[str, Any]],
    out: pathlib.Path,
    configs: dict[str, PolicyConfig],
    networks: Networks,
    physics: Engine,
    tables: Tables,
    camera: Camera,
    *,
    given: dict[str, Any],
    kept: resume.Partial,
) -> dict[str, Any]:
    """Clear the same tables with each of `configs`, in a folder of its name; continues where it was interrupted.

    Args:
      clear: `evaluation.clear`, for the tables of this worker.
      out: folder of the sweep.
      configs: by name.
      networks: that decide.
      physics: physics engine.
      tables: the tables to clear.
      camera: what the policy sees.
      given: options, for `settings.json`.
      kept: where an interrupted sweep is kept.

    Returns:
      All metrics, as `sweep/NAME/METRIC`; none of a part.
    """
    from . import on_tables

    runs = networks.runs("dipn+gn")
    longest = max(max(config.distances) for config in configs.values())
    ended: dict[str, dict[str, Any]] = kept.load({})
    remember = "memory" in given["aids"]
    policies = on_tables.load("dipn+gn", networks, physics, list(configs.values()), camera=camera)
    for name, decide in zip(configs, policies, strict=True):
        if name not in ended:
            named = given | {"label": name, "out": out / name}
            ended[name] = clear(
                out / name, decide, physics, tables, given=named, runs=runs, longest=longest, remember=remember
            )
            kept.save(ended)
    return {f"sweep/{name}/{key}": value for name, found in ended.items() for key, value in found.items()}


def _errors(
    push_net: pathlib.Path, physics: Engine, distances: tuple[float, ...], *, scenes: int, seed: int, share: Share
) -> dict[str, np.ndarray]:
    """Measure the errors of predicted masks at each of `distances`: one push on each of `scenes` as published."""
    from dipn_jax.planning.predictors import load_predictor
    from dipn_jax.world.scenes import PAPER

    from . import sweeping

    predictor = load_predictor(push_net)
    return sweeping.measured(
        predictor, physics, PAPER, distances, scenes=scenes, seed=seed, longest=max(distances), share=share
    )
