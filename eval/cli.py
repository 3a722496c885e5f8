"""`dipn-eval`: prediction, grasp, clear, sweep, report."""

from __future__ import annotations

import pathlib
import sys
from typing import Annotated, Any

import numpy as np
import tyro

from dipn_jax import console, files
from dipn_jax.engine import EngineName
from dipn_jax.errors import UserError
from dipn_jax.physics import make_engine
from dipn_jax.planning import scorers
from dipn_jax.storage import checkpoint, resume
from dipn_jax.world import scenes

from . import options
from .clearing import command, lockstep
from .grasping import curve as grasp_curves
from .grasping import success
from .prediction import curve as curves
from .prediction import push_errors
from .report import page as reporting

Objects = Annotated[str, tyro.conf.arg(help="How many: 10, 1:7 (uniform), or `paper` (1 to 7, as published).")]


def predict(
    out: pathlib.Path,
    push_net: pathlib.Path | None = None,
    curve: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="curve")] = (),
    scenes_: Annotated[int, tyro.conf.arg(name="scenes")] = 300,
    objects: Objects = "1:7",
    seed: int = 1_000_000,
    engine: EngineName = "auto",
    physics: bool = True,
    segmented: bool = True,
    ranges: scenes.Ranges = scenes.DEFAULT_RANGES,
) -> None:
    """Error of the predicted masks after 5 and 10 cm of a push, on scenes never trained on.

      dipn-eval prediction --push-net runs/dipn --out results/prediction
      dipn-eval prediction --push-net builtin --density 1000 1500 --out results/heavier

    Error against number of pushes, with a band over seeds (curve-all.png, curve-all.md, and in
    metrics.json push_error/curve/PUSHES/...):
      dipn-eval prediction --curve runs/curve/* --scenes 1000 --out results/curve

    Args:
      out: folder for metrics.json and pictures.
      push_net: run of dipn-train push, or builtin: the network that comes with the package.
      curve: runs of dipn-train push with different --limit and --seed.
      scenes_: how many pushes, one a scene.
      objects: number of objects in a scene.
      seed: of scenes and pushes; keep it away from the training data's.
      engine: what truth is.
      physics: also measure the engine itself with nominal mass and friction, the privileged ceiling.
      segmented: also measure with masks found in the image by colour and height, not taken from the simulator.
      ranges: what random objects are drawn from.
    """
    settings = dict(locals())
    options.check(out, seed, scenes=scenes_)
    if not push_net and not curve:
        raise UserError("prediction: nothing to measure; give --push-net or --curve")
    config = scenes.parse_objects(objects, ranges=ranges)
    inputs = [checkpoint.find(run, network="dipn") for run in (*([push_net] if push_net else []), *curve)]
    networks = curves.load(inputs[1:] if push_net else inputs)
    names = list(networks)
    if push_net:
        networks = {"dipn": checkpoint.load_network(inputs[0], network="dipn"), **networks}  # type: ignore[dict-item]
    partial = resume.Partial(out, settings, inputs=inputs)
    values, films = push_errors.evaluate(
        networks,
        make_engine(engine),
        config,
        partial,
        scenes=scenes_,
        seed=seed,
        physics=physics,
        segmented=segmented,
    )
    kept = {key: value for key, value in values.items() if not any(f"/{name}/" in key for name in names)}
    values = kept | curves.summary(values, names)
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out / "films.npz", **films)  # type: ignore[arg-type]
    if curve:
        for which in ("all", "moved"):
            curves.figure(values, which=which).savefig(out / f"curve-{which}.png", dpi=130)
            files.write_atomically(out / f"curve-{which}.md", curves.table(values, which=which).encode())
    options.finish(out, values, settings, partial)


def grasp(
    out: pathlib.Path,
    grasp_net: pathlib.Path | None = None,
    curve: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="curve")] = (),
    scenes_: Annotated[int, tyro.conf.arg(name="scenes")] = 100,
    objects: Objects = "10",
    seed: int = 1_000_000,
    others: int = 0,
    engine: EngineName = "auto",
    ranges: scenes.Ranges = scenes.DEFAULT_RANGES,
) -> None:
    """Success of the best-scored grasp, over every attempt until the tables are empty; a random grasp beside it.

      dipn-eval grasp --grasp-net builtin --out results/grasp

    Success against grasps learnt from, with a band over seeds (curve.png, and in metrics.json
    online/{with,without}/GRASPS/...):
      dipn-eval grasp --curve runs/online/* --out results/curve

    Args:
      out: folder for metrics.json, pictures and every step of every table.
      grasp_net: run of dipn-train grasp, or builtin.
      curve: runs of dipn-train grasp-online of different --seed, with and without --init.
      scenes_: how many tables.
      objects: number of objects on a table.
      seed: of scenes and random grasps; keep it away from the training data's.
      others: where a grasp missed, try so many of the next best ones from the same state: what physics allows.
      engine: physics.
      ranges: what random objects are drawn from.
    """
    settings = dict(locals())
    options.check(out, seed, scenes=scenes_)
    console.require_between(0, 1024, others=others)
    if not grasp_net and not curve:
        raise UserError("grasp: nothing to measure; give --grasp-net or --curve")
    config = scenes.parse_objects(objects, ranges=ranges)
    run = checkpoint.find(grasp_net, network="grasp") if grasp_net else None
    partial = resume.Partial(out, settings, inputs=[run] if run else [])
    values: dict[str, Any] = grasp_curves.summary(grasp_curves.load(curve))
    if run:
        physics = make_engine(engine)
        found, tables = success.evaluate(
            scorers.load_scorer(run), physics, config, partial, scenes=scenes_, seed=seed, others=others
        )
        alone = success.label_agreement(physics, scenes.parse_objects("1", ranges=ranges), scenes=scenes_, seed=seed)
        values |= found | {f"labels_of_single_objects/{key}": value for key, value in alone.items()}
        lockstep.save(tables, out)
        success.reliability_figure(values).savefig(out / "reliability.png", dpi=130)
    if curve:
        out.mkdir(parents=True, exist_ok=True)
        grasp_curves.figure(values).savefig(out / "curve.png", dpi=130)
    options.finish(out, values, settings, partial)


def report(
    out: pathlib.Path,
    predictions: Annotated[pathlib.Path | None, tyro.conf.arg(name="prediction")] = None,
    grasps: Annotated[pathlib.Path | None, tyro.conf.arg(name="grasp")] = None,
    clears: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="clear")] = (),
    sweeps: Annotated[pathlib.Path | None, tyro.conf.arg(name="sweep")] = None,
    runs: tuple[pathlib.Path, ...] = (),
) -> None:
    """One self-contained report.html from the folders of other commands, and their numbers in one metrics.json.

      dipn-eval report --prediction results/prediction --clear results/hard results/30 --runs runs/dipn --out results

    Args:
      out: folder for report.html and metrics.json.
      predictions: --out of dipn-eval prediction.
      grasps: --out of dipn-eval grasp.
      clears: --out of any number of dipn-eval clear: methods and tables side by side, beside the paper's numbers.
      sweeps: --out of dipn-eval sweep.
      runs: training runs, for their learning curves.
    """
    console.require_out(out)
    values = reporting.write(
        out, prediction=predictions, grasp=grasps, clears=list(clears), sweep=sweeps, runs=list(runs)
    )
    console.say(f"{out / 'report.html'}: {len(values)} numbers, also in {out / 'metrics.json'}")


COMMANDS = {
    "prediction": predict,
    "grasp": grasp,
    "clear": command.clear,
    "sweep": command.sweep,
    "report": report,
}


def main() -> None:
    """Entry point."""
    sys.exit(console.run("Measure predictors, grasps and whole policies; write the report.", COMMANDS))


if __name__ == "__main__":
    main()
