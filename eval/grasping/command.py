"""The command `dipn-eval grasp`."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Annotated

import tyro

from dipn_jax.commands import command_line, console
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError
from dipn_jax.names import ALL_AIDS, Aid, EngineName
from dipn_jax.world.ranges import DEFAULT_RANGES, Objects, Ranges

from .. import options
from ..clearing.camera import DEFAULT_CAMERA, Camera
from ..workers import shares
from ..workers.shares import WHOLE, Share


def grasp(
    out: pathlib.Path,
    grasp_net: pathlib.Path | None = None,
    curve: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="curve")] = (),
    scenes_: Annotated[int, tyro.conf.arg(name="scenes")] = 100,
    objects: Objects = "10",
    seed: int = 1_000_000,
    others: int = 0,
    aids: tuple[Aid, ...] = ALL_AIDS,
    camera: Annotated[Camera, tyro.conf.arg(name="")] = DEFAULT_CAMERA,
    engine: EngineName = "auto",
    threads: int | None = None,
    ranges: Ranges = DEFAULT_RANGES,
    share: Annotated[Share, tyro.conf.arg(name="")] = WHOLE,
    launch: Annotated[Launch, tyro.conf.arg(name="")] = LOCAL,
) -> None:
    """Measure how often the best-scored grasp holds until the tables are empty, and how often a random one does.

      dipn-eval grasp --grasp-net builtin --out results/grasp

    Success against grasps learnt from, with a band over seeds (curve.png, and in metrics.json
    online/{with,without}/GRASPS/...):
      dipn-eval grasp --curve runs/online/*/ --out results/curve

    Args:
      out: folder for metrics.json, pictures and every step of every table.
      grasp_net: run of dipn-train grasp, or builtin.
      curve: runs of dipn-train grasp-online of different --seed, with and without --init.
      scenes_: number of tables.
      objects: number of objects on a table.
      seed: random seed of scenes and random grasps; the scenes are never those of training data.
      others: where a grasp missed, also try this many of the next best ones, to see what physics allows; they are
        ranked as the policy ranked them, from the same image and with the same memory of misses.
      aids: small rules of ours that are in no paper, as of dipn-eval clear; still is not about grasps.
      camera: what GN sees; masks do not matter to it.
      engine: physics engine.
      threads: threads of the native engine; one per core by default.
      ranges: the ranges that random objects are drawn from.
      share: which part of the tables this worker tries, for dipn-eval merge.
      launch: where grasps are tried; as tasks, all shards are made and put together.
    """
    asked = dict(locals())
    settings = options.settings(asked)
    settings |= {f"camera.{name}": value for name, value in dataclasses.asdict(settings.pop("camera")).items()}
    options.check(out, seed, scenes=scenes_)
    console.require_between(0, 1024, others=others)
    if not grasp_net and not curve:
        raise UserError("grasp: nothing to measure; give --grasp-net or --curve")
    share.check(launch)
    launch.begin()
    if not grasp_net and share.of > 1:
        raise UserError("--of: without --grasp-net there are no tables to share")
    from dipn_jax.physics import grouped, make_engine
    from dipn_jax.planning import scorers
    from dipn_jax.storage import checkpoint, owner, resume
    from dipn_jax.world import scenes

    from .. import curves, drawing
    from ..clearing import lockstep
    from ..workers import launching
    from . import merging, success

    config, single = (scenes.parse_objects(count, ranges=ranges) for count in (objects, "1"))
    run = checkpoint.find(grasp_net, network="grasp") if grasp_net else None
    partial = resume.Partial(out, settings, inputs=[run] if run else [], part=share.number_and_count())
    online = curves.grasp_summary(curves.load_grasp_runs(curve)) if curve else None
    if run:
        physics = grouped.group_by_object_count(make_engine(engine, threads=threads))
        scorer = scorers.load_scorer(run, aids=aids)
    if launch.uses_cluster:
        launching.evaluate("grasp", asked, partial, total=scenes_)
        return
    with owner.owned(out):
        if shares.is_made(out, "grasp", share, partial):
            return
        if run:
            found, tables = success.tried(
                scorer,
                physics,
                config,
                partial,
                scenes=scenes_,
                seed=seed,
                others=others,
                camera=camera,
                aids=aids,
                share=share,
            )
            found |= success.labels_tried(physics, single, scenes=scenes_, seed=seed, share=share)
            names = lockstep.save(tables, out, numbers=share.rows(scenes_))
            if not share.whole:
                merging.save(out, found)
                shares.write(
                    out,
                    "grasp",
                    share,
                    total=scenes_,
                    command=command_line.words(grasp, asked, without=command_line.WORKER_OPTIONS),
                    given=settings,
                    partial=partial,
                    names=[*names, merging.TRIED],
                    about={"others": others, "online": online},
                )
                return
            values = merging.finish(out, found, tables, others=others, online=online)
        else:
            values = online or {}
            drawing.write(curves.grasp_figure(values), out / "curve.png")
        options.finish(out, values, settings, partial)
