"""Drop and push on MuJoCo C, as the project does it, against PyBullet with one process per core."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import multiprocessing
from collections.abc import Iterator
from multiprocessing.pool import Pool

import jax
import mujoco
import numpy as np
from dipn_jax.datagen.generate import Job

from benchmarks import bullet_worker
from benchmarks.bullet_worker import CONTROL_PERIOD, Settings, Work
from benchmarks.harness import Setting, Skipped, alternate, make_data
from dipn_jax import structs
from dipn_jax.physics import cores, native
from dipn_jax.structs import Push, Scene
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import model, primitives, scenes, shapes

OBJECTS = 7
"""Number of objects in a scene."""
ITEMS = tuple(item.name for item in shapes.CATALOGUE if item.shape != "concave")
"""Items of one convex part each, which PyBullet takes as they are."""
LADDER = (Settings(1 / 240, 50), Settings(1 / 480, 50), Settings(1 / 480, 100), Settings(1 / 960, 100))
"""Settings of PyBullet, from cheap to exact; the first are its defaults."""
SAME_STEP = LADDER[1]
"""Settings with about the time step of our own engine (2 ms)."""
MAX_DEPTH_RATIO = 1.25
"""Depth of contacts in a fall (`DEPTH_QUANTILE` of them) over ours that PyBullet's settings may have.

Depth at rest would say nothing: there Bullet keeps a slop of 0.01 mm at any time step.
"""
DEPTH_QUANTILE = 0.99
"""Quantile of the depths of contacts."""
STANDOFF = 0.09
"""Metres from the middle of an object at which a push comes down."""


def config() -> scenes.SceneConfig:
    """Return the scenes that both sides simulate."""
    return scenes.fixed_count(OBJECTS, ranges=scenes.Ranges(items=ITEMS))


def _drawn(seed: int, count: int) -> tuple[Scene, np.ndarray]:
    """Return scenes `[count]` in mid-air, as NumPy arrays."""
    draw = jax.jit(jax.vmap(lambda key: scenes.random_scene(key, config=config())))
    return jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(seed), count)))


def _paths(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return the gripper's middle and yaw `[count, T, 4]` every control period, through the middle of an object."""
    angle = rng.uniform(-np.pi, np.pi, count).astype(np.float32)
    toward = np.stack([np.cos(angle), np.sin(angle)], -1)
    trajectory = primitives.push_trajectory(
        Push(-np.float32(STANDOFF) * toward, angle, np.full(count, 0.1, np.float32))
    )
    times, targets = np.asarray(trajectory.time), np.asarray(trajectory.target)
    ticks = np.arange(0.0, primitives.push_samples()[-1], CONTROL_PERIOD)
    paths = [[np.interp(ticks, times[i], targets[i, :, axis]) for axis in range(4)] for i in range(count)]
    middle = np.array([0.0, 0.0, GRIPPER.finger_length / 2, 0.0])
    return np.swapaxes(np.array(paths), 1, 2) + middle


def works(seed: int, count: int, settings: Settings) -> list[Work]:
    """Divide `count` episodes among all cores."""
    scene, poses = _drawn(seed, count)
    rng = np.random.default_rng(seed)
    paths, aimed = _paths(rng, count), rng.integers(OBJECTS, size=count)
    spread = shapes.UNIT_VARIANCE[scene.shape] * scene.size**2
    inertia = scene.mass[..., None] * (spread.sum(-1, keepdims=True) - spread)
    boxes = scene.shape == shapes.CLASSES.index("cuboid")
    half = (GRIPPER.push_width / 2, GRIPPER.pad_width / 2, GRIPPER.finger_length / 2)
    moved = GRIPPER.mass + 2 * GRIPPER.finger_mass
    pieces = []
    for rows in np.array_split(np.arange(count), min(count, 4 * cores())):
        piece = Work(
            settings=settings,
            vertices=[[_corners(scene, i, slot) for slot in range(OBJECTS)] for i in rows],
            boxes=np.asarray(boxes[rows]),
            size=np.asarray(scene.size[rows]),
            mass=np.asarray(scene.mass[rows]),
            inertia=inertia[rows],
            friction=np.asarray(scene.friction[rows]),
            poses=poses[rows],
            aimed=aimed[rows],
            paths=paths[rows],
            gripper=half,
            gripper_mass=moved,
            settle_time=primitives.SETTLE_TIME,
        )
        pieces.append(piece)
    return pieces


def _corners(scene: Scene, index: int, slot: int) -> np.ndarray:
    """Return the distinct corners `[K, 3]` of a convex object."""
    return np.unique(shapes.UNIT_VERTICES[scene.shape[index, slot], 0], axis=0) * scene.size[index, slot]


def our_depth(seed: int, count: int) -> float:
    """Return the `DEPTH_QUANTILE` of the depth (metres) of all contacts in `count` falls in the native engine."""
    scene, poses = _drawn(seed, count)
    depths = []
    for i in range(count):
        text = model.mjcf(structs.take(scene, i), config=native.DEFAULTS)
        compiled = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(compiled)
        data.qpos[2] = data.ctrl[2] = 2.0  # the gripper is away
        data.qpos[model.GRIPPER_DOF :] = np.asarray(poses[i]).reshape(-1)
        while data.time < primitives.SETTLE_TIME:
            falling = data.time < primitives.SETTLE_TIME - native.ACCURATE_TIME
            config = native.DEFAULTS
            compiled.opt.timestep = config.falling_timestep if falling else config.timestep
            mujoco.mj_step(compiled, data)
            depths.append(-data.contact.dist[data.contact.dist < 0])
    return float(np.quantile(np.concatenate(depths), DEPTH_QUANTILE))


def settings_as_accurate(pool: Pool, seed: int, count: int, limit: float) -> tuple[Settings, float]:
    """Return the cheapest settings of the ladder that sink at most `limit` metres (else the last), and how deep."""
    depth = np.inf
    for settings in LADDER:
        watched = [dataclasses.replace(work, watch=True) for work in works(seed, count, settings)]
        made = pool.map(bullet_worker.episodes, watched, chunksize=1)
        depth = float(np.quantile(np.concatenate([depths for _, depths in made]), DEPTH_QUANTILE))
        if depth <= limit:
            break
    return settings, depth


def vs_pybullet(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure episodes per second over PyBullet's, and how deep objects sink in each.

    One push on each dropped scene on both sides. PyBullet is spared what costs us: it looks for no push, throws no
    episode away and writes none to disk.
    """
    if importlib.util.find_spec("pybullet") is None:
        raise Skipped("PyBullet is not installed; run pip install pybullet (the extra `bench`)")
    count = setting.pick(48, 480)
    job = Job(
        kind="push",
        scene=config(),
        episodes=count,
        seed=setting.seed,
        shard_size=-(-count // 4),
        actions=1,
        engine="native",
    )
    depth = our_depth(setting.seed + 1, 8 * cores())
    make_data(job)  # compiles
    with multiprocessing.get_context("spawn").Pool(cores()) as pool:
        pool.map(bullet_worker.ready, range(cores()), chunksize=1)
        settings, theirs_depth = settings_as_accurate(pool, setting.seed + 1, 8 * cores(), MAX_DEPTH_RATIO * depth)
        for name, chosen in (("", settings), ("/same_step", SAME_STEP)):
            work = works(setting.seed, count, chosen)
            theirs = functools.partial(pool.map, bullet_worker.episodes, work, chunksize=1)
            mine, other = alternate(lambda: make_data(job), theirs, repeats=setting.pick(2, 3))
            yield f"datagen_native.vs_pybullet{name}", other / mine
    yield "datagen_native.vs_pybullet/depth_mm", 1000 * depth
    yield "datagen_native.vs_pybullet/pybullet_depth_mm", 1000 * theirs_depth
    yield "datagen_native.vs_pybullet/pybullet_steps_per_second", 1 / settings.timestep
    yield "datagen_native.vs_pybullet/pybullet_iterations", settings.iterations
