"""Try the best-scored grasp until tables are empty; `rates` counts how often it holds."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax import batching, seeds, structs
from dipn_jax.commands import console
from dipn_jax.engine import Engine
from dipn_jax.names import ALL_AIDS, Aid
from dipn_jax.planning import candidates, methods
from dipn_jax.planning.planner import Scorer
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.seeds import Purpose
from dipn_jax.sight import render
from dipn_jax.sight.fingers import label_image
from dipn_jax.storage import resume
from dipn_jax.structs import Fault, Grasp, Observation, Scene
from dipn_jax.world import clutter, primitives
from dipn_jax.world.scenes import SceneConfig

from ..clearing import instances, lockstep, on_tables
from ..clearing.camera import DEFAULT_CAMERA, Camera
from ..clearing.instances import Instance
from ..workers.shares import WHOLE, Share
from .rates import Arrays

NO_OTHERS: Arrays = {"missed_table": np.zeros(0, int), "missed_held": np.zeros(0, bool)}
"""No miss after which others were tried."""


def tried(
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
    share: Share = WHOLE,
) -> tuple[Arrays, list[Instance]]:
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
      share: which tables this worker tries; every worker drops all of them, which takes little time.

    Returns:
      What was tried, the arrays of `rates.FORMS` but those of single objects; and the tables, ended.
    """
    tables = instances.random_instances(engine, config, count=scenes, seed=seed, purpose=Purpose.GRASP_TABLES)
    rows = np.array(share.rows(scenes))
    tables = [tables[row] for row in rows]
    found = {"random_table": rows} | _random_foreground(
        scorer, engine, tables, _random_keys(seed, scenes)[rows], camera
    )
    policy = methods.grasping_policy(scorer, PolicyConfig(aids=aids))
    decide = on_tables.in_lockstep(policy, camera=camera)
    tables = lockstep.clear(tables, engine, decide, partial, seed=seed, remember="memory" in aids)
    found["table"] = rows.repeat([len(table.did) for table in tables])
    found["held"] = np.concatenate([np.array([did == "grasp held" for did in table.did], bool) for table in tables])
    found["score"] = np.concatenate([[step["values"][0] for step in table.film] for table in tables])
    other = _other_grasps(scorer, engine, tables, others, camera=camera, seed=seed) if others else NO_OTHERS
    return found | other | {"missed_table": rows[other["missed_table"]]}, tables


def _random_keys(seed: int, scenes: int) -> jax.Array:
    """Return the random keys of the random grasps on all tables."""
    return jax.random.split(seeds.key(seed, Purpose.RANDOM_GRASPS), scenes)


def _random_foreground(
    scorer: Scorer, engine: Engine, tables: list[Instance], keys: jax.Array, camera: Camera
) -> Arrays:
    """Try a grasp of a random foreground pixel on each table; return how it went and what the scorer said."""
    scene = structs.stack([table.scene for table in tables])
    poses = np.stack([table.poses for table in tables])
    seen = camera.look(keys, scene, poses)
    grasps, scores = batching.in_batches(functools.partial(_random_grasp, scorer=scorer), keys, seen)
    rollout, outcome = primitives.grasp(engine, scene, poses, jax.device_get(grasps))
    return {
        "random_usable": Fault.usable(rollout.fault),
        "random_success": np.asarray(outcome.success),
        "random_score": np.asarray(scores),
    }


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
) -> Arrays:
    """Try the next best grasps, 16 mm apart, where GN missed; return which misses one of them would have held.

    They are ranked as the policy ranked them: from the same image, with the misses that it knew of.
    """
    misses = [
        (number, action)
        for number, table in enumerate(tables)
        for action, did in enumerate(table.did)
        if did == "grasp missed"
    ]
    if not misses:
        return NO_OTHERS
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
    one_held = np.asarray(np.concatenate(held).reshape(-1, count).any(1))
    return {"missed_table": np.array([number for number, _ in misses]), "missed_held": one_held}


@functools.partial(jax.jit, static_argnames=("scorer", "count"))
def _next_best(seen: Observation, missed: jax.Array, tried: jax.Array, *, scorer: Scorer, count: int) -> Grasp:
    def one(args: tuple[Observation, jax.Array, jax.Array]) -> Grasp:
        image, known, first = args
        scores = candidates.discount_missed(scorer(render.rgbd(image)[None])[0], known)
        best = candidates.best_grasps(candidates.exclude_near(scores, first), count=count)
        return candidates.grasp_at(best, image.height)

    return jax.lax.map(one, (seen, missed, tried))


def labels_tried(
    engine: Engine, config: SceneConfig, *, scenes: int, seed: int, each: int = 4, share: Share = WHOLE
) -> Arrays:
    """Compare the labels of pre-training with physics, for random grasps of the foreground.

    Args:
      engine: physics engine.
      config: scenes; one object in each to see what the rule is worth by itself.
      scenes: number of scenes.
      seed: random seed of scenes and grasps.
      each: grasps on every scene.
      share: which scenes this worker tries.

    Returns:
      The arrays of `rates.FORMS` of single objects.
    """
    drop, aim = jax.random.split(seeds.key(seed, Purpose.SINGLE_OBJECTS))
    rows = np.array(share.rows(scenes))
    items = structs.take(clutter.settled_scenes(drop, engine, config, scenes), rows)
    keys = jax.random.split(aim, scenes)[rows]
    grasps, labels = batching.in_batches(functools.partial(_labelled, count=each), keys, items.scene, items.poses)
    flat = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), grasps)
    index = np.repeat(np.arange(len(rows)), each)
    rollout, outcome = primitives.grasp(engine, structs.take(items.scene, index), items.poses[index], flat)
    return {
        "single_scene": rows.repeat(each),
        "single_usable": Fault.usable(rollout.fault),
        "single_label": np.asarray(labels).reshape(-1) > 0.5,
        "single_held": np.asarray(outcome.success),
    }


@functools.partial(jax.jit, static_argnames="count")
def _labelled(keys: jax.Array, scene: Scene, poses: jax.Array, *, count: int) -> tuple[Grasp, jax.Array]:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Grasp, jax.Array]:
        seen = render.render(*args[1:])
        grasps = candidates.random_grasps(args[0], seen, count=count)
        rotation, row, col = candidates.grasp_index(grasps).T
        return grasps, label_image(seen.height)[rotation, row, col]

    return jax.lax.map(one, (keys, scene, poses))
