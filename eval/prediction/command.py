"""The command `dipn-eval prediction`."""

from __future__ import annotations

import pathlib
from typing import Annotated, Any

import tyro

from dipn_jax.commands import command_line
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.world.ranges import DEFAULT_RANGES, Objects, Ranges

from .. import options
from ..workers import shares
from ..workers.shares import WHOLE, Share


def predict(
    out: pathlib.Path,
    push_net: pathlib.Path | None = None,
    curve: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="curve")] = (),
    scenes_: Annotated[int, tyro.conf.arg(name="scenes")] = 300,
    objects: Objects = "1:7",
    seed: int = 1_000_000,
    engine: EngineName = "auto",
    threads: int | None = None,
    physics: bool = True,
    segmented: bool = True,
    ranges: Ranges = DEFAULT_RANGES,
    share: Annotated[Share, tyro.conf.arg(name="")] = WHOLE,
    launch: Annotated[Launch, tyro.conf.arg(name="")] = LOCAL,
) -> None:
    """Measure the error of the predicted masks after 5 and 10 cm of a push, on scenes never trained on.

      dipn-eval prediction --push-net runs/dipn --out results/prediction
      dipn-eval prediction --push-net builtin --density 1000 1500 --out results/heavier

    Error against number of pushes, with a band over seeds (curve-all.png, curve-all.md, and in
    metrics.json push_error/curve/PUSHES/...):
      dipn-eval prediction --curve runs/curve/*/ --scenes 1000 --out results/curve

    Args:
      out: folder for metrics.json and pictures.
      push_net: run of dipn-train push, or builtin: the network that comes with the package.
      curve: runs of dipn-train push with different --limit and --seed.
      scenes_: number of pushes, one in each scene.
      objects: number of objects in a scene.
      seed: random seed of scenes and pushes, which are never those of training data.
      engine: the engine whose result counts as the truth.
      threads: threads of the native engine; one per core by default.
      physics: also measure the engine itself with nominal mass and friction, the best case.
      segmented: also measure with masks found in the image by colour and height, not taken from the simulator.
      ranges: the ranges that random objects are drawn from.
      share: which part of the pushes this worker makes, for dipn-eval merge; they are shared in groups of 64.
      launch: where pushes are made; as tasks, all shards are made and put together.
    """
    asked = dict(locals())
    settings = options.settings(asked)
    options.check(out, seed, scenes=scenes_)
    share.check(launch)
    launch.begin()
    if not push_net and not curve:
        raise UserError("prediction: nothing to measure; give --push-net or --curve")
    from dipn_jax.physics import make_engine
    from dipn_jax.storage import owner, resume
    from dipn_jax.world import scenes

    from ..workers import launching
    from . import merging, push_errors

    config = scenes.parse_objects(objects, ranges=ranges)
    networks, compared, runs = _load(push_net, curve)
    partial = resume.Partial(out, settings, inputs=runs, part=share.number_and_count())
    truth = make_engine(engine, threads=threads)
    if launch.uses_cluster:
        launching.evaluate("prediction", asked, partial, total=push_errors.groups(scenes_))
        return
    with owner.owned(out):
        if shares.is_made(out, "prediction", share, partial):
            return
        rows, films = push_errors.measured(
            networks,
            truth,
            config,
            partial,
            scenes=scenes_,
            seed=seed,
            physics=physics,
            segmented=segmented,
            share=share,
        )
        if share.whole:
            merging.save_films(out, films)
            options.finish(out, merging.finish(out, rows, compared), settings, partial)
            return
        shares.write(
            out,
            "prediction",
            share,
            total=push_errors.groups(scenes_),
            command=command_line.words(predict, asked, without=command_line.WORKER_OPTIONS),
            given=settings,
            partial=partial,
            names=merging.save(out, rows, films),
            about={"arrays": list(rows), "compared": compared},
        )


def _load(
    push_net: pathlib.Path | None, curve: tuple[pathlib.Path, ...]
) -> tuple[dict[str, Any], list[str], list[pathlib.Path]]:
    """Load the networks to measure, `push_net` as `dipn`.

    Returns:
      All networks by name, the names of those of the learning curve, and the runs of all.
    """
    from dipn_jax.storage import checkpoint

    from .. import curves

    single = [checkpoint.find(push_net, network="dipn")] if push_net else []
    runs = [checkpoint.find(each, network="dipn") for each in curve]
    compared = curves.load_push_runs(runs)
    networks = {"dipn": checkpoint.load_network(single[0], network="dipn")} if single else {}
    return networks | compared, list(compared), [*single, *runs]
