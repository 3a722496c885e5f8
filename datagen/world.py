"""Figures that show whether the world is right: drops, pushes, grasps, the camera and the engines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.names import EngineName
from dipn_jax.physics import native
from dipn_jax.sight import render
from dipn_jax.structs import Fault, Grasp, Push, SettledScene
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import clutter, model, primitives, scenes, shapes

from . import episodes, isolated

DROPPED_COUNTS = (1, 3, 7, 10, 20, 30)
"""Numbers of objects for which drops are measured."""
CROWDED_COUNTS = (10, 20, 30)
"""Numbers of objects for which drops are also measured with engines that keep a limited number of contacts."""
MOVED_DISTANCE = 0.001
"""Metres by which the reference has to move an object in a push for it to count in the engines' agreement."""
GRASPS_PER_SCENE = 4
"""Grasps of each scene in the engines' agreement; with one alone, the share would be of too few."""
AS_PUT_ANGLE = np.deg2rad(5)
"""Radians by which an object that stays as it is put may turn."""
Metrics = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Variant:
    """An engine with settings that differ from its defaults."""

    engine: EngineName
    timestep: float | None = None  # seconds
    sleep: float | None = None  # see `PhysicsConfig`


ENGINES = {
    "native_awake": Variant("native", sleep=0.0),
    "native_1ms": Variant("native", timestep=0.001),
    "native_3.3ms": Variant("native", timestep=0.01 / 3),
    "native_5ms": Variant("native", timestep=0.005),
    "mjx": Variant("mjx"),
    "mjx_warp": Variant("mjx_warp"),
    "warp": Variant("warp"),
}
"""Engines that can be compared with `native` as it is (2 ms, resting objects asleep)."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """Settled scenes, with a push and some grasps for each."""

    items: SettledScene  # [B]
    pushes: Push  # [B]
    grasps: Grasp  # [B, A]

    def first(self, count: int) -> Trial:
        """Return the first `count` scenes of the trial."""
        some = slice(0, count)
        items, pushes = structs.take(self.items, some), structs.take(self.pushes, some)
        return Trial(items, pushes, structs.take(self.grasps, some))


def drops(
    key: jax.Array, engine: Engine, tries: int, *, name: str = "drop", counts: Sequence[int] = DROPPED_COUNTS
) -> Metrics:
    """Measure random drops: shares `{name}/{objects}/kept` and `{name}/{objects}/{fault}`."""
    found: Metrics = {}
    for count in counts:
        kept, counted = clutter.settled(key, engine, scenes.parse_objects(str(count)), tries)
        found[f"{name}/{count}/tries"] = tries
        found[f"{name}/{count}/kept"] = len(kept.fault) / tries
        for fault, n in counted.items():
            if fault != "dropped_scenes":
                found[f"{name}/{count}/{fault.removeprefix('settle_')}"] = n / tries
    return found


def rests(name: str, engine: Engine, seed: int) -> Metrics:
    """Measure `rest/{engine}/...`: every catalogue item set down on every face that it can stand on.

    The shares that come to rest, and that stay as they were put (within AS_PUT_ANGLE), the largest turn, and the
    largest distance of the lowest corner from the table at rest.
    """
    made = [isolated.standing(np.random.default_rng(seed), item) for item in shapes.CATALOGUE]
    scene, poses = structs.concatenate([scene for scene, _ in made]), np.concatenate([start for _, start in made])
    rollout = primitives.settle(engine, scene, poses, duration=0.6)
    after, fault = np.asarray(rollout.poses)[:, -1], np.asarray(rollout.fault)
    gap = 1000 * np.abs(shapes.lowest_corner(scene.shape, scene.size, after, xp=np))[fault == 0]
    turn = _turn(after[..., 3:], poses[..., 3:])
    return {
        f"rest/{name}/at_rest": float((fault == 0).mean()),
        f"rest/{name}/as_put": float((turn < AS_PUT_ANGLE).mean()),
        f"rest/{name}/turn_max_deg": float(np.rad2deg(turn.max())),
        f"rest/{name}/from_table_max_mm": float(gap.max()),
        f"rest/{name}/tries": len(fault),
    }


def isolated_grasps(engine: Engine, seed: int, tries: int) -> Metrics:
    """Measure `grasp_isolated/{shape}`, the share of `isolated.share_held`; and grasps that must not hold."""
    found = {}
    for item in shapes.CATALOGUE:
        found[f"grasp_isolated/{item.name}"], count = isolated.share_held(
            engine, np.random.default_rng(seed), item, tries
        )
        found[f"grasp_isolated_tries/{item.name}"] = count
    for name, share in isolated.shares_of_long(engine, np.random.default_rng(seed), tries).items():
        found[f"grasp_{name}/held"] = share
    return found


def trial(key: jax.Array, engine: Engine, count: int, *, config: scenes.SceneConfig | None = None) -> Trial:
    """Draw `count` scenes, each with a random feasible push and GRASPS_PER_SCENE random grasps.

    Args:
      key: random key.
      engine: that they come to rest in.
      count: of scenes; fewer if pushes are feasible on less than half of those that are drawn.
      config: of the scenes; 1 to 7 objects if not given.
    """
    drop, aim = jax.random.split(key)
    items = clutter.settled_scenes(drop, engine, config or scenes.SceneConfig(), max(2 * count, 8))
    keys = jax.random.split(aim, len(items.fault))
    pushes, feasible = episodes.aim_pushes(keys, items.scene, items.poses, actions=1)
    grasps = episodes.aim_grasps(keys, items.scene, items.poses, actions=GRASPS_PER_SCENE)
    index = np.flatnonzero(np.asarray(feasible)[:, 0])[:count]
    pushes = jax.tree.map(lambda leaf: np.asarray(leaf)[index, 0], pushes)
    return Trial(structs.take(items, index), pushes, structs.take(grasps, index))


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle `[...]` (radians) of orientations `[..., 4]`; by the chord, as cosines near 1 lack digits."""
    a, b = (q / np.linalg.norm(q, axis=-1, keepdims=True) for q in (np.asarray(a, float), np.asarray(b, float)))
    chord = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return 4 * np.arcsin(np.clip(chord / 2, 0.0, 1.0))


def pushes(engine: Engine, made: Trial) -> tuple[Metrics, np.ndarray]:
    """Measure `push/...`: shares of outcomes of pushes and pushed objects; also return the poses `[B, 12, N, 7]`."""
    rollout = primitives.push(engine, made.items.scene, made.items.poses, made.pushes)
    poses, fault = np.asarray(rollout.poses), np.asarray(rollout.fault)
    moved = np.linalg.norm(poses[:, -1, :, :3] - poses[:, 0, :, :3], axis=-1) > MOVED_DISTANCE
    tipped = np.asarray(primitives.tipped(poses[:, 0, :, 3:], poses[:, -1, :, 3:]))
    deep = [_depths(made, poses[:, k], np.asarray(rollout.gripper)[:, k]).max() for k in range(PUSH_STEPS + 1)]
    found = {
        "push/tipped_of_moved": float(tipped[moved].mean()),
        "push/moved_objects": float(moved.sum()),
        "push/depth_max_mm": 1000 * float(max(deep)),
    }
    for name, n in Fault.count(fault).items():
        found[f"push/{name}"] = n / len(fault)
    return found, poses


def _depths(made: Trial, poses: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """Return the deepest contact `[B]` (metres) among objects, table and gripper; tunnelling shows as a deep one."""
    scene = made.items.scene
    texts = [model.mjcf(structs.take(scene, i), config=native.DEFAULTS, alike=True) for i in range(len(poses))]
    models = [mujoco.MjModel.from_xml_string(text) for text in texts]
    hand = np.concatenate([gripper[:, :4], gripper[:, 4:] / 2, gripper[:, 4:] / 2], -1)
    return native.contact_depths(models, np.concatenate([hand, poses.reshape(len(poses), -1)], -1))


def sweep(engine: Engine, made: Trial, poses: np.ndarray) -> Metrics:
    """Measure how far pushes of `k` cm end from the poses at `k` cm of a longer push, as `sweep/{k}cm/...`."""
    found = {}
    for centimetres in (3, 5, 7):
        short = made.pushes.replace(distance=np.full(len(poses), centimetres * 0.01, np.float32))
        after = np.asarray(primitives.push(engine, made.items.scene, made.items.poses, short).poses)[:, -1]
        found.update(_apart(f"sweep/{centimetres}cm", poses[:, centimetres], after, poses))
    return found


def _apart(name: str, found: np.ndarray, wanted: np.ndarray, poses: np.ndarray) -> Metrics:
    """Return quantiles of distance and angle between poses `[B, N, 7]`, of objects moved in `poses [B, S, N, 7]`."""
    moved = np.linalg.norm(poses[:, PUSH_STEPS, :, :3] - poses[:, 0, :, :3], axis=-1) > MOVED_DISTANCE
    distance = 1000 * np.linalg.norm(found[..., :3] - wanted[..., :3], axis=-1)[moved]
    angle = np.rad2deg(_turn(found[..., 3:], wanted[..., 3:]))[moved]
    if not moved.any():
        return {}
    return {
        f"{name}/{q}_{unit}": float(np.quantile(values, share))
        for unit, values in (("mm", distance), ("deg", angle))
        for q, share in (("p50", 0.5), ("p90", 0.9))
    }


def agreement(name: str, engine: Engine, made: Trial, poses: np.ndarray, held: np.ndarray) -> Metrics:
    """Measure how far an engine's pushes and grasps are from the reference's, as `agreement/{engine}/...`."""
    rollout = primitives.push(engine, made.items.scene, made.items.poses, made.pushes)
    found: Metrics = {}
    for centimetres in (1, 5, 10):
        at = np.asarray(rollout.poses)[:, centimetres]
        found.update(_apart(f"agreement/{name}/{centimetres}cm", at, poses[:, centimetres], poses))
    found[f"agreement/{name}/grasp"] = float((held_by(engine, made) == held).all(-1).mean())
    found[f"agreement/{name}/grasps"] = held.shape[0] * held.shape[1]
    found[f"agreement/{name}/grasps_that_held"] = int(held.any(-1).sum())
    fault = np.asarray(rollout.fault)
    found[f"agreement/{name}/unsettled"] = Fault.count(fault)["unsettled"] / len(fault)
    found[f"agreement/{name}/scenes"] = len(fault)
    return found


def camera(key: jax.Array, engine: Engine, count: int) -> Metrics:
    """Measure `camera/...`: the renderer against MuJoCo's ray caster on scenes of ten objects."""
    items = clutter.settled_scenes(key, engine, scenes.fixed_count(10), count)
    seen = jax.jit(lambda scene, poses: jax.lax.map(lambda pair: render.render_depth(*pair), (scene, poses)))
    height, label = (np.asarray(x) for x in seen(items.scene, jnp.asarray(items.poses)))
    wanted_height, wanted_label = native.raycast(items.scene, items.poses)
    same = label == wanted_label
    apart = 1000 * np.abs(height - wanted_height)[same]
    return {
        "camera/labels_equal": float(same.mean()),
        "camera/heights_equal": float((apart < 0.1).mean()),
        "camera/heights_apart": int((apart >= 0.1).sum()),
        "camera/height_max_mm": float(apart.max()),
        "camera/scenes": count,
    }


def held_by(engine: Engine, made: Trial) -> np.ndarray:
    """Return which objects an engine holds after each grasp `[B, A, N]`, every grasp from the settled scene."""
    held = []
    for action in range(np.shape(made.grasps.angle)[1]):
        grasps = jax.tree.map(lambda leaf, a=action: np.asarray(leaf)[:, a], made.grasps)
        held.append(primitives.grasp(engine, made.items.scene, made.items.poses, grasps)[1].held)
    return np.stack([np.asarray(each) for each in held], 1)
