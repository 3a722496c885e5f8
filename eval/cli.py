"""`dipn-eval`: prediction, grasp, clear, report."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import Annotated, Any

import numpy as np
import tyro

from dipn_jax import checkpoint, console, files, policy, resume, scenes
from dipn_jax.errors import UserError
from dipn_jax.physics import EngineName, make_engine
from eval import clearing, deciding, grasp_curve, grasping, metrics, prediction
from eval import curve as curves
from eval import report as reporting
from eval.instances import Instance, Tables

Objects = Annotated[str, tyro.conf.arg(help="How many: 10, 1:7 (uniform), or `paper` (1 to 7, as published).")]


MAX_CANDIDATES = 4096


def _check(out: pathlib.Path, seed: int, **counts: int) -> None:
    console.require_positive(**counts)
    console.require_seed(seed)
    console.require_out(out)


def _plain(value: Any) -> Any:
    """An option as JSON can hold it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, pathlib.Path) else value


def _finish(out: pathlib.Path, values: dict[str, Any], settings: dict[str, Any], partial: resume.Partial) -> None:
    metrics.write(out, values, settings={key: _plain(value) for key, value in settings.items()})
    partial.finish()
    for name, value in values.items():
        console.say(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")


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
    _check(out, seed, scenes=scenes_)
    if not push_net and not curve:
        raise UserError("prediction: nothing to measure; give --push-net or --curve")
    config = scenes.parse_objects(objects, ranges=ranges)
    inputs = [checkpoint.find(run, network="dipn") for run in (*([push_net] if push_net else []), *curve)]
    networks = curves.load(inputs[1:] if push_net else inputs)
    names = list(networks)
    if push_net:
        networks = {"dipn": checkpoint.load_network(inputs[0], network="dipn"), **networks}  # type: ignore[dict-item]
    partial = resume.Partial(out, settings, inputs=inputs)
    values, films = prediction.evaluate(
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
    _finish(out, values, settings, partial)


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
    _check(out, seed, scenes=scenes_)
    console.require_between(0, 1024, others=others)
    if not grasp_net and not curve:
        raise UserError("grasp: nothing to measure; give --grasp-net or --curve")
    config = scenes.parse_objects(objects, ranges=ranges)
    run = checkpoint.find(grasp_net, network="grasp") if grasp_net else None
    partial = resume.Partial(out, settings, inputs=[run] if run else [])
    values: dict[str, Any] = grasp_curve.summary(grasp_curve.load(curve))
    if run:
        physics = make_engine(engine)
        found, tables = grasping.evaluate(
            policy.load_scorer(run), physics, config, partial, scenes=scenes_, seed=seed, others=others
        )
        alone = grasping.label_agreement(physics, scenes.parse_objects("1", ranges=ranges), scenes=scenes_, seed=seed)
        values |= found | {f"labels_of_single_objects/{key}": value for key, value in alone.items()}
        clearing.save(tables, out)
        grasping.reliability_figure(values).savefig(out / "reliability.png", dpi=130)
    if curve:
        out.mkdir(parents=True, exist_ok=True)
        grasp_curve.figure(values).savefig(out / "curve.png", dpi=130)
    _finish(out, values, settings, partial)


DEFAULT_TABLES = Tables()


def clear(
    out: pathlib.Path,
    method: deciding.MethodName = "dipn+gn",
    push_net: pathlib.Path | None = None,
    grasp_net: pathlib.Path | None = None,
    value_net: pathlib.Path | None = None,
    tables: Annotated[Tables, tyro.conf.arg(name="")] = DEFAULT_TABLES,
    candidates: int = 32,
    distance: float = 0.10,
    gamma: float = 0.9,
    threshold: float = 0.7,
    released: bool = False,
    seed: int = 1_000_000,
    engine: EngineName = "auto",
) -> None:
    """Clear tables: push or grasp, until nothing is left.

      dipn-eval clear --push-net builtin --grasp-net builtin --cases hard --instances 30 --out results/hard
      dipn-eval clear --push-net builtin --grasp-net builtin --cases random --objects 30 --instances 30 --out results/30

    The compared methods: gn (grasps only), physics+gn (the engine itself as predictor), and with networks of dipn-train
    baseline rea+dipn, dqn+gn and vpg:
      dipn-eval clear --method dqn+gn --value-net runs/dqn --grasp-net builtin --out results/dqn

    Args:
      out: folder for metrics.json and every step of every table.
      method: who decides.
      push_net: run of dipn-train push, or builtin.
      grasp_net: run of dipn-train grasp, or builtin.
      value_net: run of dipn-train baseline.
      tables: which.
      candidates: pushes considered at a time.
      distance: metres of a push.
      gamma: discount of a push's value.
      threshold: grasp at once above this score.
      released: decide by the clauses of DIPN's released code, too: a lone object is grasped, a push must raise the best
        score, gamma discounts only pushes after which that is over 0.5, and no object may come near the edge.
      seed: of scenes, perturbations and candidates.
      engine: physics.
    """
    settings = dict(locals()) | {f"tables.{key}": value for key, value in dataclasses.asdict(tables).items()}
    del settings["tables"]
    plan = _plan(out, seed, method, candidates, (distance,), gamma, threshold, released)
    values, ended, partial = _cleared(out, plan, deciding.Nets(push_net, grasp_net, value_net), tables, settings)
    clearing.save(ended, out)
    _finish(out, values, settings, partial)


def _plan(
    out: pathlib.Path,
    seed: int,
    method: deciding.MethodName,
    candidates: int,
    distances: tuple[float, ...],
    gamma: float,
    threshold: float,
    released: bool,
) -> deciding.Plan:
    """The plan of options that make sense."""
    _check(out, seed, candidates=candidates)
    console.require_between(1, MAX_CANDIDATES, candidates=candidates)
    for distance in distances:
        console.require_between(0.01, deciding.LONGEST, distance=distance)
    console.require_between(0.0, 10.0, gamma=gamma, threshold=threshold)
    return deciding.Plan(method, candidates, distances, gamma, threshold, released)


def _cleared(
    out: pathlib.Path, plan: deciding.Plan, nets: deciding.Nets, tables: Tables, settings: dict[str, Any]
) -> tuple[dict[str, Any], list[Instance], resume.Partial]:
    """Metrics, and the tables, ended."""
    seed = settings["seed"]
    path, slots = tables.path(), tables.slots()
    inputs = [*nets.require(plan.method).values(), *([path] if path else [])]
    physics = make_engine(settings["engine"])
    decide = deciding.load(plan, nets, physics, slots=slots)
    partial = resume.Partial(out, settings, inputs=inputs)
    start = tables.make(physics, seed=seed)
    ended = clearing.clear(start, physics, decide, partial, seed=seed, longest=plan.longest())
    return clearing.summary(ended), ended, partial


def report(
    out: pathlib.Path,
    predictions: Annotated[pathlib.Path | None, tyro.conf.arg(name="prediction")] = None,
    grasps: Annotated[pathlib.Path | None, tyro.conf.arg(name="grasp")] = None,
    hard: pathlib.Path | None = None,
    random: pathlib.Path | None = None,
    runs: tuple[pathlib.Path, ...] = (),
) -> None:
    """One self-contained report.html from the folders of other commands, and their numbers in one metrics.json.

      dipn-eval report --prediction results/prediction --hard results/hard --runs runs/dipn runs/gn --out results

    Args:
      out: folder for report.html and metrics.json.
      predictions: --out of dipn-eval prediction.
      grasps: --out of dipn-eval grasp.
      hard: --out of dipn-eval clear --cases hard.
      random: --out of dipn-eval clear --cases random.
      runs: training runs, for their learning curves.
    """
    console.require_out(out)
    values = reporting.write(out, prediction=predictions, grasp=grasps, hard=hard, random=random, runs=list(runs))
    console.say(f"{out / 'report.html'}: {len(values)} numbers, also in {out / 'metrics.json'}")


COMMANDS = {"prediction": predict, "grasp": grasp, "clear": clear, "report": report}


def main() -> None:
    """Entry point."""
    sys.exit(console.run("Measure predictors, grasps and whole policies; write the report.", COMMANDS))


if __name__ == "__main__":
    main()
