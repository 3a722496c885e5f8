"""How often does the best-scored grasp hold, until tables are empty? And does a score mean what it says?"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from dipn_jax import batching, console, seeds, structs
from dipn_jax.engine import Engine
from dipn_jax.names import ALL_AIDS, Aid
from dipn_jax.planning import candidates, methods
from dipn_jax.planning.planner import Scorer
from dipn_jax.seeds import Purpose
from dipn_jax.sight import render
from dipn_jax.sight.fingers import label_image
from dipn_jax.storage import resume
from dipn_jax.structs import Fault, Grasp, Observation, Scene
from dipn_jax.world import clutter, primitives
from dipn_jax.world.scenes import SceneConfig

from .. import metrics
from ..clearing import instances, lockstep, on_tables
from ..clearing.camera import DEFAULT_CAMERA, Camera
from ..clearing.instances import Instance

BINS = 10
"""Number of bins of scores."""


def evaluate(
    scorer: Scorer,
    engine: Engine,
    config: SceneConfig,
    partial: resume.Partial,
    *,
    scenes: int,
    seed: int,
    others: int = 0,
    camera: Camera = DEFAULT_CAMERA,
    aids: tuple[Aid, ...] = ALL_AIDS,
) -> tuple[dict[str, Any], list[Instance]]:
    """Try the best-scored grasp until every table is empty, by the end rules of `eval.clearing`; also a random one.

    Args:
      scorer: scores of every grasp.
      engine: physics engine.
      config: scenes.
      partial: where an interrupted evaluation is kept.
      scenes: number of tables.
      seed: random seed of the scenes and of the random grasps.
      others: where a grasp missed, how many of the next best to try, each from the same state; 0: none.
      camera: what the scorer sees.
      aids: those of choosing a grasp that are not the scorer's, `top` and `memory`.

    Returns:
      Flat metrics: success with bootstrap 95 % intervals over tables, calibration; and the tables, ended.
    """
    tables = instances.random_instances(engine, config, count=scenes, seed=seed, purpose=Purpose.GRASP_TABLES)
    result = _random_foreground(scorer, engine, tables, seed, camera)
    policy = methods.grasping_policy(scorer, methods.PolicyConfig(aids=aids))
    decide = on_tables.in_lockstep(policy, camera=camera)
    tables = lockstep.clear(tables, engine, decide, partial, seed=seed, remember="memory" in aids)
    held = [np.array([did == "grasp held" for did in table.did], float) for table in tables]
    scores = np.concatenate([[step["values"][0] for step in table.film] for table in tables])
    result |= _rate("gn", [each.sum() for each in held], [len(each) for each in held])
    result |= _rate("gn_first", [each[0] for each in held], [1] * len(held))
    result |= {f"table/{key}": value for key, value in lockstep.summary(tables).items() if key.startswith("ended_")}
    result |= {"attempts": len(scores), "scenes": scenes}
    result |= calibration(scores, np.concatenate(held))
    if others:
        result |= _other_grasps(scorer, engine, tables, others, camera=camera, seed=seed)
    return result, tables


def _rate(name: str, hits: Any, trials: Any) -> dict[str, float]:
    value, low, high = metrics.ratio_interval(hits, trials)
    return {f"grasp_success/{name}": value, f"grasp_success/{name}_low": low, f"grasp_success/{name}_high": high}


def _random_foreground(
    scorer: Scorer, engine: Engine, tables: list[Instance], seed: int, camera: Camera
) -> dict[str, Any]:
    """Try a grasp of a random foreground pixel on each table; return how it went and what the scorer said."""
    scene = structs.stack([table.scene for table in tables])
    poses = np.stack([table.poses for table in tables])
    keys = jax.random.split(seeds.key(seed, Purpose.RANDOM_GRASPS), len(tables))
    seen = camera.look(keys, scene, poses)
    grasps, scores = batching.in_batches(functools.partial(_random_grasp, scorer=scorer), keys, seen)
    rollout, outcome = primitives.grasp(engine, scene, poses, jax.device_get(grasps))
    good = Fault.usable(rollout.fault)
    success = np.asarray(outcome.success, float)[good]
    found = calibration(np.asarray(scores)[good], success)
    return _rate("random_foreground", success, np.ones(len(success))) | {f"random/{k}": v for k, v in found.items()}


@functools.partial(jax.jit, static_argnames="scorer")
def _random_grasp(keys: jax.Array, seen: Observation, *, scorer: Scorer) -> tuple[Grasp, jax.Array]:
    def one(args: tuple[jax.Array, Observation]) -> tuple[Grasp, jax.Array]:
        key, seen = args
        grasps = candidates.random_grasps(key, seen, count=1)
        chosen: Grasp = jax.tree.map(lambda leaf: leaf[0], grasps)
        rotation, row, col = candidates.grasp_index(chosen)
        return chosen, scorer(render.rgbd(seen)[None])[0, rotation, row, col]

    return jax.lax.map(one, (keys, seen))


def _other_grasps(
    scorer: Scorer,
    engine: Engine,
    tables: list[Instance],
    count: int,
    *,
    camera: Camera = DEFAULT_CAMERA,
    seed: int = 0,
) -> dict[str, float]:
    """Measure how often one of the next best grasps, 16 mm apart, would have held where GN missed.

    They are ranked as the policy ranked them: from the same image, with the misses that it knew of.
    """
    misses = [
        (number, action)
        for number, table in enumerate(tables)
        for action, did in enumerate(table.did)
        if did == "grasp missed"
    ]
    result: dict[str, float] = {"other_grasps/missed": len(misses), "other_grasps/tried_each": count}
    if not misses:
        return result
    steps = [tables[number].film[action] for number, action in misses]
    scenes = [tables[n].scene.replace(shape=step["shape"]) for (n, _), step in zip(misses, steps, strict=True)]
    scene = structs.stack(scenes)
    poses, missed, tried = (np.stack([step[key] for step in steps]) for key in ("poses", "missed", "grasp"))
    keys = jnp.stack([lockstep.action_key(seed, tables[number].number, action) for number, action in misses])
    seen = camera.look(keys, scene, poses)
    grasps = batching.in_batches(functools.partial(_next_best, scorer=scorer, count=count), seen, missed, tried)
    flat = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), grasps)
    index = np.repeat(np.arange(len(steps)), count)
    held, begin = [], 0
    with console.Progress("other grasps", len(index), unit="grasps") as progress:
        while begin < len(index):
            rows = slice(begin, begin + engine.batch)
            rollout, outcome = primitives.grasp(
                engine, structs.take(scene, index[rows]), poses[index[rows]], structs.take(flat, rows)
            )
            held.append(np.asarray(outcome.success) & Fault.usable(rollout.fault))
            begin += engine.batch
            progress.advance(len(held[-1]), "")
    any_held = np.concatenate(held).reshape(-1, count).any(1)
    attempts = sum(len(table.did) for table in tables)
    result["other_grasps/one_holds"] = float(any_held.mean())
    result["other_grasps/ceiling"] = 1 - float((~any_held).sum()) / attempts
    return result


@functools.partial(jax.jit, static_argnames=("scorer", "count"))
def _next_best(seen: Observation, missed: jax.Array, tried: jax.Array, *, scorer: Scorer, count: int) -> Grasp:
    def one(args: tuple[Observation, jax.Array, jax.Array]) -> Grasp:
        image, known, first = args
        scores = candidates.discount_missed(scorer(render.rgbd(image)[None])[0], known)
        best = candidates.best_grasps(candidates.without(scores, first), count=count)
        return candidates.grasp_at(best, image.height)

    return jax.lax.map(one, (seen, missed, tried))


def label_agreement(engine: Engine, config: SceneConfig, *, scenes: int, seed: int, each: int = 4) -> dict[str, float]:
    """Measure how often the labels of pre-training agree with physics, for random grasps of the foreground.

    Args:
      engine: physics engine.
      config: scenes; one object in each to see what the rule is worth by itself.
      scenes: number of scenes.
      seed: random seed of scenes and grasps.
      each: grasps on every scene.
    """
    drop, aim = jax.random.split(seeds.key(seed, Purpose.SINGLE_OBJECTS))
    items = clutter.settled_scenes(drop, engine, config, scenes)
    keys = jax.random.split(aim, scenes)
    grasps, labels = batching.in_batches(functools.partial(_labelled, count=each), keys, items.scene, items.poses)
    flat = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), grasps)
    index = np.repeat(np.arange(scenes), each)
    rollout, outcome = primitives.grasp(engine, structs.take(items.scene, index), items.poses[index], flat)
    good = Fault.usable(rollout.fault)
    said, held = np.asarray(labels).reshape(-1)[good] > 0.5, np.asarray(outcome.success)[good]
    rates = {"agree": said == held, "positive_holds": held[said], "negative_fails": ~held[~said], "positive": said}
    return {"grasps": len(said)} | {name: float(np.mean(rate)) for name, rate in rates.items()}


@functools.partial(jax.jit, static_argnames="count")
def _labelled(keys: jax.Array, scene: Scene, poses: jax.Array, *, count: int) -> tuple[Grasp, jax.Array]:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Grasp, jax.Array]:
        seen = render.render(*args[1:])
        grasps = candidates.random_grasps(args[0], seen, count=count)
        rotation, row, col = candidates.grasp_index(grasps).T
        return grasps, label_image(seen.height)[rotation, row, col]

    return jax.lax.map(one, (keys, scene, poses))


def calibration(scores: np.ndarray, success: np.ndarray) -> dict[str, float]:
    """Return the expected calibration error over ten equal bins of score (Naeini et al. 2015), and the bins.

    Args:
      scores: `[A]` in [0, 1].
      success: `[A]` 0 or 1.
    """
    bins = np.clip((scores * BINS).astype(int), 0, BINS - 1)
    result: dict[str, float] = {}
    error = 0.0
    for b in range(BINS):
        inside = bins == b
        if inside.any():
            said, came = float(scores[inside].mean()), float(success[inside].mean())
            error += float(inside.mean()) * abs(came - said)
            result |= {f"reliability/{b}/count": int(inside.sum()), f"reliability/{b}/score": said}
            result[f"reliability/{b}/success"] = came
    return {"expected_calibration_error": error, **result}


def reliability_figure(values: dict[str, Any]) -> Any:
    """Plot success against score: the grasps that GN chose, and random ones."""
    figure, axis = plt.subplots(figsize=(4.2, 4))
    axis.plot([0, 1], [0, 1], color="grey", lw=1)
    for prefix, label in (("", "chosen by GN"), ("random/", "random")):
        found = [b for b in range(BINS) if f"{prefix}reliability/{b}/count" in values]
        points = [[values[f"{prefix}reliability/{b}/{key}"] for b in found] for key in ("score", "success", "count")]
        label += f", ECE {values[f'{prefix}expected_calibration_error']:.3f}"
        axis.plot(points[0], points[1], marker="o", label=label)
        for x, y, n in zip(*points, strict=True):
            axis.annotate(str(int(n)), (x, y), fontsize=6, xytext=(3, -8), textcoords="offset points")
    axis.set(xlabel="score", ylabel="share that held", xlim=(0, 1), ylim=(0, 1.02))
    axis.legend(fontsize=8)
    return figure
