"""How much room MuJoCo Warp needs: contacts, pairs and rows an object, seen in drops, pushes and grasps."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import jax
import numpy as np
from dipn_jax.datagen import episodes

from benchmarks.harness import Setting, Skipped
from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.physics import hosted, make_engine
from dipn_jax.physics.warp import WarpEngine
from dipn_jax.physics.warp_worlds import Worlds
from dipn_jax.structs import Rollout, Scene, Trajectory
from dipn_jax.world import clutter, primitives, scenes

COUNTS = (1, 3, 7, 10, 20, 30)
"""Numbers of objects."""
EVERY = 0.05
"""Seconds between the states of a rollout that are looked at."""
NEEDS = ("contacts", "pairs", "rows")
"""What is counted in a state."""


def seen(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure `engines.warp_room/NEED/OBJECTS`: a scene's largest need, divided by its objects plus 1, the gripper.

    MuJoCo C makes the rollouts, and MuJoCo Warp finds the contacts of their states.
    """
    if importlib.util.find_spec("warp") is None:
        raise Skipped("MuJoCo Warp is not installed; run pip install 'dipn-jax[warp]'")
    native, engine = make_engine("native"), WarpEngine()
    for count in COUNTS:
        most = np.zeros(len(NEEDS))
        for scene, rollout in _rollouts(native, count, setting.pick(8, 64), setting.seed):
            most = np.maximum(most, needs(engine, scene, rollout).max(0))
        yield from ((f"engines.warp_room/{need}/{count}", n / (count + 1)) for need, n in zip(NEEDS, most, strict=True))


def _rollouts(native: Engine, count: int, tries: int, seed: int) -> Iterator[tuple[Scene, Rollout]]:
    """Drop, push and grasp `tries` scenes of `count` objects; the rollouts have a sample every `EVERY` seconds."""
    drop, aim = jax.random.split(jax.random.key(seed))
    scene, poses = jax.vmap(lambda key: scenes.random_scene(key, config=scenes.fixed_count(count)))(
        jax.random.split(drop, tries)
    )

    def follow(scene: Scene, poses: np.ndarray, paths: Trajectory, fence: float = 0.0) -> tuple[Scene, Rollout]:
        times = np.arange(0.0, float(np.asarray(paths.time)[:, -1].min()), EVERY)
        return scene, native.simulate(scene, poses, paths, times, fence=fence)

    still = primitives.parked_trajectory(tries, primitives.SETTLE_TIME)
    yield follow(scene, poses, still, primitives.FENCE_TIME)
    items = clutter.settled_scenes(drop, native, scenes.fixed_count(count), tries)
    keys = jax.random.split(aim, tries)
    pushes, _ = episodes.aim_pushes(keys, items.scene, items.poses, actions=1)
    grasps = episodes.aim_grasps(keys, items.scene, items.poses, actions=1)
    first = [jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], action) for action in (pushes, grasps)]
    for paths in (primitives.push_trajectory(first[0]), primitives.grasp_trajectory(first[1])):
        yield follow(items.scene, np.asarray(items.poses), paths)


def needs(engine: WarpEngine, scene: Scene, rollout: Rollout) -> np.ndarray:
    """Return how many of `NEEDS` there are `[B S, 3]` in each state of rollouts of `scene [B, N]`."""
    batch, states = rollout.poses.shape[:2]
    packed, slots = hosted.pack(structs.take(scene, np.repeat(np.arange(batch), states)))
    poses, hand = (leaf.reshape(batch * states, *leaf.shape[2:]) for leaf in (rollout.poses, rollout.gripper))
    bodies = np.take_along_axis(poses, slots[..., None], 1).reshape(len(poses), -1)
    hand = np.concatenate([hand[:, :4], hand[:, 4:] / 2, hand[:, 4:] / 2], -1)
    with engine.warp.ScopedDevice(engine.device):
        worlds = Worlds(packed, 2, engine)
        worlds.data.qpos.assign(np.concatenate([hand, bodies], -1).astype(np.float32))
        engine.mujoco_warp.fwd_position(worlds.model, worlds.data)
        return _count(engine, worlds, len(poses))


def _count(engine: WarpEngine, worlds: Worlds, states: int) -> np.ndarray:
    data, kind = worlds.data, engine.mujoco_warp.OverflowType
    if (data.overflow.numpy() & int(kind.BROADPHASE | kind.NARROWPHASE | kind.CCD | kind.NEFC | kind.NJMAX_NNZ)).any():
        raise RuntimeError("no room for what was to be counted")
    contacts = int(data.nacon.numpy()[0])
    world, geoms = data.contact.worldid.numpy()[:contacts], data.contact.geom.numpy()[:contacts]
    pairs = np.unique(np.column_stack([world, geoms])[geoms[:, 0] > 0], axis=0)  # geom 0 is the table, a plane
    found = (np.bincount(each, minlength=states) for each in (world, pairs[:, 0]))
    return np.stack([*found, data.nefc.numpy()], -1)
