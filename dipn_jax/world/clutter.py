"""Random scenes at rest, from a key, for data generation and evaluation; and how objects are removed by a grasp."""

from __future__ import annotations

import functools

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from dipn_jax import batching, structs
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.structs import Array, Fault, Grasp, Scene, SettledScene
from dipn_jax.system import forking
from dipn_jax.world import primitives, scenes

MAX_DROPS = 128
"""Drops in a row without a usable scene after which `settled_scenes` gives up."""


def settled(
    key: Key[Array, ""], engine: Engine, config: scenes.SceneConfig, count: int
) -> tuple[SettledScene, dict[str, int]]:
    """Drop `count` random scenes and return those that came to rest inside the workspace without a fault.

    Args:
      key: random key.
      engine: physics engine.
      config: distributions.
      count: scenes dropped.

    Returns:
      The scenes kept `[K]`, and how many were dropped and why others were not kept.
    """
    everything = drop(key, engine, config, count)
    return structs.take(everything, np.asarray(everything.fault) == 0), drop_counts(everything.fault)


def drop(key: Key[Array, ""], engine: Engine, config: scenes.SceneConfig, count: int) -> SettledScene:
    """Drop `count` random scenes and return them as they lie then, on the engine's side, with the faults of some."""
    forking.check()
    draw = functools.partial(_random_scenes, config=config)
    scene, poses = batching.in_batches(draw, jax.random.split(key, count))
    rollout = primitives.settle(engine, scene, poses, fence=primitives.FENCE_TIME)
    return SettledScene(scene, rollout.poses[:, -1], rollout.fault)


def drop_counts(fault: Int[Array, " B"]) -> dict[str, int]:
    """Return how many scenes were dropped and how many ended with each fault, from their fault codes."""
    return {"dropped_scenes": len(fault), **{f"settle_{name}": n for name, n in Fault.count(fault).items()}}


def settled_scenes(key: Key[Array, ""], engine: Engine, config: scenes.SceneConfig, count: int) -> SettledScene:
    """Drop random objects until `count` scenes have come to rest.

    Example:
      engine, config = dipn_jax.make_engine("native"), dipn_jax.SceneConfig()
      tables = dipn_jax.settled_scenes(jax.random.key(0), engine, config, 16)
      observation = dipn_jax.render(tables.scene[0], tables.poses[0])

    Raises:
      UserError: `MAX_DROPS` drops in a row gave none.
    """
    kept: list[SettledScene] = []
    in_vain = 0
    while (missing := count - sum(len(batch.fault) for batch in kept)) > 0:
        key, drop = jax.random.split(key)
        tries = min(engine.batch, int(1.2 * missing) + 2)
        batch, counts = settled(drop, engine, config, tries)
        in_vain = 0 if len(batch.fault) else in_vain + tries
        if in_vain >= MAX_DROPS:
            raise UserError(
                f"scenes: {in_vain} drops, none at rest inside the workspace ({counts}); ask for fewer objects"
            )
        kept.append(structs.take(batch, slice(0, missing)))
    return structs.concatenate(kept)


def grasp_away(
    engine: Engine, scene: Scene, poses: Float[Array, "B N 7"], grasps: Grasp
) -> tuple[Scene, Float[np.ndarray, "B N 7"], Bool[np.ndarray, "B N"], Int[np.ndarray, " B"]]:
    """Execute one grasp per scene, remove what is held, and let the rest come to rest.

    Args:
      engine: physics engine.
      scene: B scenes.
      poses: poses of their objects, before.
      grasps: one a scene.

    Returns:
      Scenes and poses afterwards, which objects were held, and faults of both simulations.
    """
    rollout, outcome = primitives.grasp(engine, scene, poses, grasps)
    held = np.asarray(outcome.held)
    scene, after = jax.device_get(scenes.remove(scene, np.asarray(rollout.poses)[:, -1], held))
    rest = primitives.settle(engine, scene, after, duration=primitives.RESETTLE_TIME)
    return scene, np.asarray(rest.poses)[:, -1], held, np.asarray(rollout.fault) | np.asarray(rest.fault)


@functools.partial(jax.jit, static_argnames="config")
def _random_scenes(keys: Key[Array, " B"], config: scenes.SceneConfig) -> tuple[Scene, Float[jax.Array, "B N 7"]]:
    return jax.vmap(lambda k: scenes.random_scene(k, config=config))(keys)
