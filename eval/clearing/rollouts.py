"""The engine itself says what pushes do: the ceiling of imagination (`physics+gn`)."""

from __future__ import annotations

import functools

import jax
import numpy as np

from dipn_jax import batching, geometry, structs
from dipn_jax.engine import Engine
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Proposal, Rule
from dipn_jax.sight import masks, render
from dipn_jax.structs import Array, Fault, Scene
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import primitives, scenes

from . import choices
from .choices import Choice


def decide(
    scorer: planner.Scorer,
    appraise: planner.Appraiser,
    engine: Engine,
    rule: Rule,
    distances: np.ndarray,
    keys: jax.Array,
    scene: Scene,
    poses: Array,
    missed: Array,
) -> Choice:
    """Choices for the tables `[B]`: Alg. 2 with the engine as predictor, which knows shapes but guesses what is unseen.

    Args:
      scorer: scores of every grasp.
      appraise: what all grasps on a predicted image are worth.
      engine: physics.
      rule: how to compare.
      distances: `[P]` metres of the candidates.
      keys: `[B]` random keys, for the candidates.
      scene: `[B, N]`; masses and frictions are replaced by nominal ones.
      poses: `[B, N, 7]`.
      missed: `[B, M, 3]` grasps that missed.
    """
    propose = functools.partial(_proposals, scorer=scorer, rule=rule, distances=distances)
    proposals = batching.in_small_batches(propose, keys, scene, poses, missed)
    motion, believed = _motions(engine, scene, poses, proposals, max(float(max(distances)), PUSH_STEPS * 0.01))
    proposals = proposals.replace(feasible=proposals.feasible & believed)
    choose = functools.partial(_chosen, appraise=appraise, rule=rule)
    chosen: Choice = batching.in_small_batches(choose, scene, poses, proposals, motion)
    return chosen


@functools.partial(jax.jit, static_argnames="scorer")
def _proposals(
    keys: jax.Array,
    scene: Scene,
    poses: jax.Array,
    missed: jax.Array,
    real: jax.Array,
    *,
    scorer: planner.Scorer,
    rule: Rule,
    distances: jax.Array,
) -> Proposal:
    def one(args: tuple[jax.Array, Scene, jax.Array, jax.Array, jax.Array]) -> Proposal:
        key, scene, poses, missed, wanted = args
        options = {"count": len(distances), "slots": scene.shape.shape[0], "distance": distances, "missed": missed}
        found = planner.propose(key, render.render(scene, poses), scorer, rule, **options)
        return found.replace(settled=found.settled | ~wanted)

    return jax.lax.map(one, (keys, scene, poses, missed, real))


def _motions(
    engine: Engine, scene: Scene, poses: Array, proposals: Proposal, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Motions `[B, P, N, 3]` of the pushes that matter, as the engine with nominal masses and frictions has them.

    And which of their simulations can be believed, `[B, P]` bool.
    """
    asked = proposals.feasible & ~proposals.settled[:, None]
    table, which = np.nonzero(asked)
    motion, believed = np.zeros((*asked.shape, scene.shape.shape[1], 3), np.float32), np.ones(asked.shape, bool)
    guess = scenes.nominal(scene)
    centers = np.asarray(batching.in_batches(_centers, guess, poses))
    for begin in range(0, len(table), engine.batch):
        rows, push = table[begin : begin + engine.batch], which[begin : begin + engine.batch]
        pushes = jax.tree.map(lambda leaf, r=rows, p=push: leaf[r, p], proposals.pushes)
        rollout = primitives.push(engine, structs.take(guess, rows), poses[rows], pushes, longest=longest)
        after = np.asarray(rollout.poses)[:, -1]
        good = Fault.usable(rollout.fault)
        moved = np.asarray(geometry.planar_motion(poses[rows], after, centers[rows]))
        motion[rows, push], believed[rows, push] = np.where(good[:, None, None], moved, 0.0), good
    return motion, believed


@jax.jit
def _centers(scene: Scene, poses: jax.Array) -> jax.Array:
    def one(pair: tuple[Scene, jax.Array]) -> jax.Array:
        return masks.mask_centers(render.render(*pair).label, pair[1].shape[0])[0]

    return jax.lax.map(one, (scene, poses))


@functools.partial(jax.jit, static_argnames="appraise")
def _chosen(
    scene: Scene,
    poses: jax.Array,
    proposals: Proposal,
    motion: jax.Array,
    real: jax.Array,
    *,
    appraise: planner.Appraiser,
    rule: Rule,
) -> Choice:
    def one(args: tuple[Scene, jax.Array, Proposal, jax.Array, jax.Array]) -> Choice:
        scene, poses, proposal, motion, wanted = args
        seen = render.render(scene, poses)
        proposal = proposal.replace(settled=proposal.settled | ~wanted)
        return choices.choice(seen, planner.choose(seen, proposal, motion, appraise, rule))

    return jax.lax.map(one, (scene, poses, proposals, motion, real))
