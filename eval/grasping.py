"""How often does the best-scored grasp hold? Against a random foreground pixel at a random angle, same scenes."""

from __future__ import annotations

import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax import candidates, clutter, console, policy, primitives, render, resume
from dipn_jax.physics import Engine
from dipn_jax.planner import Scorer
from dipn_jax.scenes import SceneConfig
from dipn_jax.structs import Fault, Grasp, Scene
from eval import metrics

BINS = 10


def evaluate(
    grasp_net: pathlib.Path,
    engine: Engine,
    config: SceneConfig,
    partial: resume.Partial,
    *,
    scenes: int,
    seed: int,
) -> dict[str, float]:
    """One grasp of each kind on each of `scenes` settled scenes.

    Args:
      grasp_net: run of `dipn-train grasp`.
      engine: physics.
      config: scenes.
      partial: where an interrupted evaluation is kept.
      scenes: how many.
      seed: of the scenes and of the random grasps.

    Returns:
      Flat metrics: success with 95 % intervals, and the expected calibration error of the executed scores.
    """
    scorer = policy.load_scorer(grasp_net)
    held: dict[str, list[np.ndarray]] = {"gn": [], "random_foreground": []}
    scores: list[np.ndarray] = []
    done, batch, held, scores = partial.load((0, 0, held, scores))
    with console.Progress("grasping", scenes, unit="scenes", done=done) as progress:
        while done < scenes:
            drop, aim = jax.random.split(jax.random.fold_in(jax.random.key(seed), batch))
            items = clutter.settled_exactly(drop, engine, config, min(clutter.BATCH, scenes - done))
            best, best_score, anywhere = _choose(scorer, aim, items.scene, items.poses)
            for name, grasps in (("gn", best), ("random_foreground", anywhere)):
                rollout, outcome = primitives.grasp(engine, items.scene, items.poses, grasps)
                wrong = (np.asarray(rollout.fault) & Fault.UNUSABLE) != 0
                held[name].append(np.where(wrong, np.nan, np.asarray(outcome.success)))
            scores.append(np.asarray(best_score))
            done, batch = done + len(items.fault), batch + 1
            partial.save((done, batch, held, scores))
            progress.advance(len(items.fault))
    result: dict[str, float] = {"attempts": done}
    for name, parts in held.items():
        success = np.concatenate(parts)
        result[f"unusable/{name}"] = int(np.isnan(success).sum())
        success = success[np.isfinite(success)]
        rate, low, high = metrics.ratio_interval(success, np.ones(len(success)))
        result |= {f"grasp_success/{name}": rate, f"grasp_success/{name}_low": low, f"grasp_success/{name}_high": high}
    success = np.concatenate(held["gn"])
    usable = np.isfinite(success)
    result["expected_calibration_error"] = calibration_error(np.concatenate(scores)[usable], success[usable])
    return result


@functools.partial(jax.jit, static_argnames="scorer")
def _choose(scorer: Scorer, key: jax.Array, scene: Scene, poses: jax.Array) -> tuple[Grasp, jax.Array, Grasp]:
    """For each scene: the best grasp, its score, and a random foreground grasp."""

    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Grasp, jax.Array, Grasp]:
        k, one_scene, one_poses = args
        seen = render.render(one_scene, one_poses)
        index, score = candidates.best_grasp(scorer(render.rgbd(seen)[None])[0])
        anywhere = jax.tree.map(lambda leaf: leaf[0], candidates.random_grasps(k, seen, count=1))
        return candidates.grasp_at(index, seen.height), score, anywhere

    keys = jax.random.split(key, poses.shape[0])
    return jax.lax.map(one, (keys, jax.tree.map(jnp.asarray, scene), jnp.asarray(poses)))


def calibration_error(scores: np.ndarray, success: np.ndarray) -> float:
    """Expected calibration error over ten equal bins of score (Naeini et al. 2015)."""
    bins = np.clip((scores * BINS).astype(int), 0, BINS - 1)
    error = 0.0
    for b in range(BINS):
        inside = bins == b
        if inside.any():
            error += inside.mean() * abs(float(success[inside].mean()) - float(scores[inside].mean()))
    return error
