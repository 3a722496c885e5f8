"""The command `dipn-eval clear`."""

from __future__ import annotations

import pathlib
from typing import Annotated

import tyro

from dipn_jax.commands import command_line
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.names import ALL_AIDS, Aid, EngineName, MethodName

from ..workers.shares import WHOLE, Share
from . import evaluation
from .camera import DEFAULT_CAMERA, Camera
from .tables import DEFAULT_TABLES, Tables


def clear(
    out: pathlib.Path,
    method: MethodName = "dipn+gn",
    push_net: pathlib.Path | None = None,
    grasp_net: pathlib.Path | None = None,
    value_net: pathlib.Path | None = None,
    tables: Annotated[Tables, tyro.conf.arg(name="")] = DEFAULT_TABLES,
    camera: Annotated[Camera, tyro.conf.arg(name="")] = DEFAULT_CAMERA,
    candidates: int = 32,
    distances: tuple[float, ...] = (0.10,),
    gamma: float = 0.9,
    threshold: float = 0.7,
    released: bool = False,
    aids: tuple[Aid, ...] = ALL_AIDS,
    label: str = "",
    seed: int = 1_000_000,
    engine: EngineName = "auto",
    threads: int | None = None,
    share: Annotated[Share, tyro.conf.arg(name="")] = WHOLE,
    launch: Annotated[Launch, tyro.conf.arg(name="")] = LOCAL,
) -> None:
    """Clear tables: push or grasp, until nothing is left.

      dipn-eval clear --push-net builtin --grasp-net builtin --cases hard --instances 10 --out results/hard
      dipn-eval clear --push-net builtin --grasp-net builtin --cases random --objects 30 --instances 30 --out results/30

    With pushes only where they save more than the action that they cost: --method dipn+gn+actions.

    The compared methods: gn (grasps only), physics+gn (the engine itself as predictor), and with networks of dipn-train
    baseline rea+dipn, dqn+gn and vpg:
      dipn-eval clear --method dqn+gn --value-net runs/dqn --grasp-net builtin --out results/dqn

    Without any aid, with scores as the network gives them and the rule as published:
      dipn-eval clear --push-net builtin --grasp-net builtin --aids --label bare --out results/bare

    A quarter of the tables, as one of four workers; dipn-eval merge makes one evaluation of their parts:
      dipn-eval clear --push-net builtin --grasp-net builtin --instances 30 --shard 0 --of 4 --out results/part-0

    Args:
      out: folder for metrics.json and every step of every table.
      method: how to decide.
      push_net: run of dipn-train push, or builtin.
      grasp_net: run of dipn-train grasp, or builtin.
      value_net: run of dipn-train baseline.
      tables: the tables to clear.
      camera: what the method sees; physics+gn takes --masks true only.
      candidates: pushes considered at a time.
      distances: metres of a push; of several, the candidates have one each, in turn, and the best is chosen.
      gamma: factor of a push's value, 0 to 1.
      threshold: score, 0 to 1, above which the best grasp is made at once.
      released: add the clauses of DIPN's released code: a lone object is grasped; a push must raise the best score,
        too; gamma applies only to pushes after which that is over 0.5; and no object may leave the workspace if it
        moves twice as far as predicted.
      aids: small rules of ours that are in no paper; docs/concepts.md says what each does. --aids with nothing behind
        it: none of them.
      label: for the report, what distinguishes this evaluation from others of its method, such as the data learnt from.
      seed: random seed of scenes, perturbations, noise and candidates.
      engine: physics engine.
      threads: threads of the native engine; one per core by default.
      share: which part of the tables this worker clears.
      launch: where tables are cleared; as tasks, all shards are made and put together.
    """
    asked = dict(locals())
    given = evaluation.settings(asked)
    from dipn_jax.physics import grouped, make_engine
    from dipn_jax.planning.methods import Networks
    from dipn_jax.planning.policy_config import PolicyConfig
    from dipn_jax.storage import resume

    from ..workers import launching
    from . import on_tables

    evaluation.check(out, seed, tables, candidates=candidates, distances=distances, gamma=gamma, threshold=threshold)
    config = PolicyConfig(
        candidates=candidates, distances=distances, gamma=gamma, grasp_above=threshold, released=released, aids=aids
    )
    share.check(launch)
    launch.begin()
    networks = Networks(push_net, grasp_net, value_net)
    physics = grouped.group_by_object_count(make_engine(engine, threads=threads))
    if launch.uses_cluster:
        whole = resume.Partial(out, given, inputs=evaluation.inputs(networks.runs(method), tables))
        launching.evaluate("clear", asked, whole, total=tables.count())
        return
    (decide,) = on_tables.load(method, networks, physics, [config], camera=camera)
    longest, runs = max(*distances, evaluation.SIMULATED_PUSH), networks.runs(method)
    remember = "memory" in aids
    evaluation.clear(
        out,
        decide,
        physics,
        tables,
        given=given,
        runs=runs,
        longest=longest,
        remember=remember,
        share=share,
        command=command_line.words(clear, asked, without=command_line.WORKER_OPTIONS),
    )
