"""`dipn-eval`: prediction, grasp, clear, report."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from dipn_jax import checkpoint, console, files, policy, resume, scenes
from dipn_jax.errors import UserError
from dipn_jax.physics import EngineName, make_engine
from eval import clearing, grasp_curve, grasping, metrics, prediction
from eval import curve as curves
from eval import instances as tables_to_clear
from eval import report as reporting

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


def clear(
    grasp_net: pathlib.Path,
    out: pathlib.Path,
    push_net: pathlib.Path | None = None,
    method: Literal["dipn+gn", "gn"] = "dipn+gn",
    cases: str = "hard",
    names: tuple[str, ...] = (),
    objects: Objects = "10",
    instances: int = 1,
    candidates: int = 32,
    distance: float = 0.10,
    gamma: float = 0.9,
    threshold: float = 0.7,
    seed: int = 1_000_000,
    engine: EngineName = "auto",
) -> None:
    """Clear tables with Alg. 2: push or grasp, until nothing is left.

      dipn-eval clear --push-net runs/dipn --grasp-net runs/gn --cases hard --out results/hard
      dipn-eval clear --push-net runs/dipn --grasp-net runs/gn --cases random --instances 30 --out results/random

    Args:
      grasp_net: run of dipn-train grasp.
      out: folder for metrics.json and every step of every table.
      push_net: run of dipn-train push, or builtin.
      method: dipn+gn, or gn: grasps only.
      cases: hard (the ten hand-placed instances), random, or a case file of your own.
      names: only these cases of the file.
      objects: number of objects (random).
      instances: tables (random), or repeats of each case with perturbed physics.
      candidates: pushes considered at a time.
      distance: metres of a push.
      gamma: discount of a push's value.
      threshold: grasp at once above this score.
      seed: of scenes, perturbations and candidates.
      engine: physics.
    """
    settings = dict(locals())
    _check(out, seed, instances=instances, candidates=candidates)
    console.require_between(1, MAX_CANDIDATES, candidates=candidates)
    console.require_between(0.01, 0.10, distance=distance)
    console.require_between(0.0, 10.0, gamma=gamma, threshold=threshold)
    physics = make_engine(engine)
    config = clearing.ClearConfig(method, candidates, distance, gamma, threshold)
    if cases == "random":
        scene_config = scenes.parse_objects(objects)
        slots = scene_config.slots
    else:
        path = scenes.hard_cases_path() if cases == "hard" else pathlib.Path(cases)
        slots = scenes.load_cases(path)[1].shape.shape[1]
    predictor, scorer = clearing.load_policies(config, push_net, grasp_net, slots)
    if cases == "random":
        tables = tables_to_clear.random_instances(physics, scene_config, count=instances, seed=seed)
    else:
        tables = tables_to_clear.hard_instances(
            physics, path, list(names) or None, slots=slots, repeats=instances, seed=seed
        )
    inputs = [checkpoint.find(grasp_net, network="grasp"), *([] if cases == "random" else [path])]
    if push_net:
        inputs.append(checkpoint.find(push_net, network="dipn"))
    partial = resume.Partial(out, settings, inputs=inputs)
    tables = clearing.clear(tables, physics, predictor, scorer, config, partial, seed=seed)
    clearing.save(tables, out)
    _finish(out, clearing.summary(tables), settings, partial)


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
