"""Decisions with the engine itself as predictor (`physics+gn`), which no network can be expected to beat."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import numpy as np

from dipn_jax import batching, geometry, structs
from dipn_jax.engine import Engine
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Rule
from dipn_jax.sight import masks, render
from dipn_jax.structs import Array, Candidates, Decision, Fault, Observation, Scene
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import primitives, scenes


def decide_by_simulation(
    keys: jax.Array,
    scene: Scene,
    poses: Array,
    recall: Callable[[Array], Array],
    *,
    scorer: planner.Scorer,
    summarize: planner.ScoreSummary,
    engine: Engine,
    rule: Rule,
    distances: np.ndarray,
) -> tuple[Decision, Observation]:
    """Decide on the tables `[B]` by Alg. 2 with the engine as predictor: it knows shapes, guesses mass and friction.

    Args:
      keys: `[B]` random keys, for the candidates.
      scene: `[B, N]`; masses and frictions are replaced by nominal ones.
      poses: `[B, N, 7]`.
      recall: gives the grasps that missed, `[B, M, 3]`, from height maps `[B, H, W]`.
      scorer: scores of every grasp.
      summarize: mean and highest score of all grasps on predicted images.
      engine: physics engine.
      rule: how to compare.
      distances: `[P]` metres of the candidates.

    Returns:
      Brief decisions `[B]`, and what was seen, with the simulator's masks, `[B]`.
    """
    seen: Observation = jax.device_get(render.observe(scene, poses))
    find = functools.partial(_find_candidates, scorer=scorer, rule=rule, distances=distances)
    found = batching.in_small_batches(find, keys, scene, poses, recall(seen.height))
    motion, usable = _motions(engine, scene, poses, found, max(float(max(distances)), PUSH_STEPS * 0.01))
    found = found.replace(feasible=found.feasible & usable)
    choose = functools.partial(_decide_among, summarize=summarize, rule=rule)
    return batching.in_small_batches(choose, scene, poses, found, motion), seen


@functools.partial(jax.jit, static_argnames="scorer")
def _find_candidates(
    keys: jax.Array,
    scene: Scene,
    poses: jax.Array,
    missed: jax.Array,
    real: jax.Array,
    *,
    scorer: planner.Scorer,
    rule: Rule,
    distances: jax.Array,
) -> Candidates:
    def one(args: tuple[jax.Array, Scene, jax.Array, jax.Array, jax.Array]) -> Candidates:
        key, scene, poses, missed, wanted = args
        seen, count = render.render(scene, poses), len(distances)
        found = planner.find_candidates(key, seen, scorer, rule, count=count, distance=distances, missed=missed)
        return found.replace(grasp_now=found.grasp_now | ~wanted)

    return jax.lax.map(one, (keys, scene, poses, missed, real))


def _motions(
    engine: Engine, scene: Scene, poses: Array, found: Candidates, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the pushes that matter with nominal masses and frictions.

    Returns:
      Their motions `[B, P, N, 3]`, and which of the simulations can be believed, `[B, P]` bool.
    """
    asked = found.feasible & ~found.grasp_now[:, None]
    table, which = np.nonzero(asked)
    motion, usable = np.zeros((*asked.shape, scene.shape.shape[1], 3), np.float32), np.ones(asked.shape, bool)
    guess = scenes.nominal(scene)
    centers = np.asarray(batching.in_batches(_centers, guess, poses))
    for begin in range(0, len(table), engine.batch):
        rows, push = table[begin : begin + engine.batch], which[begin : begin + engine.batch]
        rollout = primitives.push(
            engine, structs.take(guess, rows), poses[rows], found.pushes[rows, push], longest=longest
        )
        after = np.asarray(rollout.poses)[:, -1]
        good = Fault.usable(rollout.fault)
        moved = np.asarray(geometry.planar_motion(poses[rows], after, centers[rows]))
        motion[rows, push], usable[rows, push] = np.where(good[:, None, None], moved, 0.0), good
    return motion, usable


@jax.jit
def _centers(scene: Scene, poses: jax.Array) -> jax.Array:
    def one(pair: tuple[Scene, jax.Array]) -> jax.Array:
        return masks.mask_centers(render.render(*pair).label, pair[1].shape[0])[0]

    return jax.lax.map(one, (scene, poses))


@functools.partial(jax.jit, static_argnames="summarize")
def _decide_among(
    scene: Scene,
    poses: jax.Array,
    found: Candidates,
    motion: jax.Array,
    real: jax.Array,
    *,
    summarize: planner.ScoreSummary,
    rule: Rule,
) -> Decision:
    def one(args: tuple[Scene, jax.Array, Candidates, jax.Array, jax.Array]) -> Decision:
        scene, poses, found, motion, wanted = args
        found = found.replace(grasp_now=found.grasp_now | ~wanted)
        return planner.decide_among(render.render(scene, poses), found, motion, summarize, rule).brief()

    return jax.lax.map(one, (scene, poses, found, motion, real))
