"""MJX compared with MuJoCo C: the same episodes, by XLA and by the kernel of Warp, one program for everything."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from object_sizes import SIZES

from dipn_jax.errors import UserError
from dipn_jax.physics import mjx, mjx_program
from dipn_jax.physics.mjx import MjxEngine, OnDevice
from dipn_jax.physics.native import NativeEngine
from dipn_jax.structs import ABSENT, Fault, Grasp, Push, Scene, Trajectory
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import primitives, scenes, shapes

pytestmark = pytest.mark.slow
BATCH = 4  # scenes that the program takes
SLOTS = 3  # object slots of a scene
POSITION_TOLERANCE = 0.003
"""Metres between the engines after 5 cm of a push: float32 and another solver. On 32 random scenes (docs/world.md) the
90th percentile is 1.3 mm, as contacts between objects multiply differences."""
FALL_SECONDS = 0.1
"""Seconds in which a heap falls: its objects hit one another, and engines are 1 mm apart (10 mm at 0.2 s)."""
CLASS = {name: i for i, name in enumerate(shapes.CLASSES)}
LINES = (
    ("cuboid", "concave", "cylinder"),
    ("concave", "half_cylinder", None),
    ("half_cylinder", "cuboid", "triangular_prism"),
    ("triangular_prism", "cylinder", None),
)

FOUR_DEVICES = """
import dataclasses, sys, jax, numpy as np
from dipn_jax.commands import console
from dipn_jax.world import primitives, scenes
from dipn_jax.physics.mjx import DEFAULTS, MjxEngine
from dipn_jax.physics.native import NativeEngine
console.enable_compilation_cache()
assert jax.device_count() == 4
keys, config = jax.random.split(jax.random.key(0), 8), scenes.fixed_count(1)
scene, poses = jax.tree.map(np.asarray, jax.vmap(lambda key: scenes.random_scene(key, config=config))(keys))
many = MjxEngine(dataclasses.replace(DEFAULTS, solver=sys.argv[1]))
found, wanted = (primitives.settle(e, scene, poses, duration=0.1) for e in (many, NativeEngine(many.config)))
np.testing.assert_allclose(found.poses[..., :3], wanted.poses[..., :3], atol=1e-3)
np.testing.assert_array_equal(found.fault, wanted.fault)
"""
"""A script for four virtual devices, each of which simulates two of eight falling objects, with the solver given."""


@pytest.fixture(scope="session")
def engine() -> MjxEngine:
    """Return one engine for the whole file: compiling its only program takes most of the time."""
    return MjxEngine()


@pytest.fixture(scope="session")
def reference(engine: MjxEngine) -> NativeEngine:
    return NativeEngine(engine.config)


def _lines() -> tuple[Scene, np.ndarray]:
    """Return four scenes, each with objects in a row along y, a little above the table."""
    shape = np.array([[ABSENT if name is None else CLASS[name] for name in line] for line in LINES], np.int32)
    size = np.array([[SIZES[name or "cuboid"] for name in line] for line in LINES], np.float32)
    mass = np.where(shape >= 0, 500 * shapes.volume(shape, size), 0.1).astype(np.float32)
    poses = np.tile(np.array(scenes.parked(SLOTS)), (BATCH, 1, 1))
    for b, s in np.argwhere(shape >= 0):
        poses[b, s] = [0.01 * s, 0.1 * (s - 1), size[b, s, 2] / 2 + 0.01, 1, 0, 0, 0]
    friction = np.full(shape.shape, 0.35, np.float32)
    return Scene(shape, size, np.zeros_like(size), mass, friction), poses


@pytest.fixture(scope="session")
def settled(reference: NativeEngine) -> tuple[Scene, np.ndarray]:
    scene, poses = _lines()
    rollout = primitives.settle(reference, scene, poses, duration=0.8)
    assert not np.asarray(rollout.fault).any()
    return scene, np.asarray(rollout.poses[:, 0])


@pytest.fixture(scope="session")
def pushed(engine: MjxEngine, settled: tuple[Scene, np.ndarray]) -> tuple[Push, Any]:
    """Push the middle object along x without touching another; this also compiles the program."""
    scene, poses = settled
    start = jnp.asarray(poses[:, 1, :2] - np.array([0.055, 0.0]), jnp.float32)
    push = Push(start, jnp.zeros(BATCH), jnp.full(BATCH, 0.1))
    return push, primitives.push(engine, scene, poses, push)


def test_push_ends_where_mujoco_c_puts_it(
    reference: NativeEngine, settled: tuple[Scene, np.ndarray], pushed: tuple[Push, Any]
) -> None:
    scene, poses = settled
    push, found = pushed
    wanted = primitives.push(reference, scene, poses, push)
    rolls_on = Fault.UNSETTLED  # a cylinder may
    np.testing.assert_array_equal(found.fault & ~rolls_on, wanted.fault & ~rolls_on)
    at = 5
    moved = np.linalg.norm(wanted.poses[:, at, 1, :2] - poses[:, 1, :2], axis=-1)
    assert (moved > 0.01).all()
    apart = np.linalg.norm(found.poses[:, at, :, :3] - wanted.poses[:, at, :, :3], axis=-1)[scene.shape >= 0]
    assert apart.max() < POSITION_TOLERANCE, apart
    np.testing.assert_allclose(found.gripper[:, at], wanted.gripper[:, at], atol=1e-3)


def test_grasps_of_isolated_objects_agree_in_the_same_program(
    engine: MjxEngine, reference: NativeEngine, settled: tuple[Scene, np.ndarray], pushed: tuple[Push, Any]
) -> None:
    scene, poses = settled
    alone = scene.replace(shape=np.where(np.arange(SLOTS) == 0, scene.shape, ABSENT))
    center = poses[:, 0, :2] + np.array([[0, 0], [0, 0], [0, 0], [0.2, 0]])  # the last one misses
    grasp = Grasp(jnp.asarray(center, jnp.float32), jnp.full(BATCH, np.pi / 2), jnp.full(BATCH, 0.02))
    compiled = dict(engine.programs)
    rollout, found = primitives.grasp(engine, alone, poses, grasp)
    _, wanted = primitives.grasp(reference, alone, poses, grasp)
    np.testing.assert_array_equal(found.held, wanted.held)
    assert np.asarray(found.success).any() and not np.asarray(found.success).all()
    np.testing.assert_array_equal(rollout.poses[:, :, 1:], np.tile(poses[:, None, 1:], (1, 2, 1, 1)))
    primitives.settle(engine, scene, poses, duration=0.05)
    assert engine.programs == compiled and len(compiled) == 1  # the one that pushed


def test_the_kernel_of_warp_pushes_and_drops_as_xla_and_mujoco_c_do(
    engine: MjxEngine,
    reference: NativeEngine,
    settled: tuple[Scene, np.ndarray],
    pushed: tuple[Push, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError("a time step of MJX is traced")

    monkeypatch.setattr(mjx_program.mjx, "step", refuse)
    kernels = MjxEngine(dataclasses.replace(engine.config, solver="warp"))
    scene, poses = settled
    push, by_xla = pushed
    found = primitives.push(kernels, scene, poses, push)
    wanted, at, present = primitives.push(reference, scene, poses, push), 5, scene.shape >= 0
    for other, most in ((by_xla, 0.001), (wanted, POSITION_TOLERANCE)):
        apart = np.linalg.norm(found.poses[:, at, :, :3] - other.poses[:, at, :, :3], axis=-1)[present]
        assert apart.max() < most, apart
        np.testing.assert_array_equal(found.fault & ~Fault.UNSETTLED, other.fault & ~Fault.UNSETTLED)

    turn = np.float32([0, 0, 0, 0, 0.3, 0.2, 0.1])
    heap = np.where(present[..., None], poses + turn, poses)
    heap[..., 3:] /= np.linalg.norm(heap[..., 3:], axis=-1, keepdims=True)
    for s in range(1, SLOTS):  # each on the one before it
        heap[:, s, :3] = np.where(present[:, s, None], heap[:, s - 1, :3] + [0.01, 0.01, 0.09], heap[:, s, :3])
    found, by_xla, wanted = (
        primitives.settle(e, scene, heap, duration=FALL_SECONDS) for e in (kernels, engine, reference)
    )
    fallen = np.linalg.norm(wanted.poses[:, 0, :, :3] - heap[..., :3], axis=-1)[present]
    assert (fallen > 0.005).all()
    for other, most in ((by_xla, 1e-4), (wanted, POSITION_TOLERANCE)):
        apart = np.linalg.norm(found.poses[:, 0, :, :3] - other.poses[:, 0, :, :3], axis=-1)[present]
        assert apart.max() < most, apart


def test_a_fault_stays_in_its_episode(engine: MjxEngine, settled: tuple[Scene, np.ndarray]) -> None:
    scene, poses = settled
    clean = primitives.settle(engine, scene, poses, duration=0.1)
    bad = np.array(poses)
    bad[0, 0, 2] = np.nan
    bad[1, 0, 0] = 0.3
    bad[2, 0, 2] += 0.1  # still falling at the end
    bad[3, 2] = np.nan  # an empty slot
    found = primitives.settle(engine, scene, bad, duration=0.1)
    assert not clean.fault.any()
    assert found.fault[0] & Fault.NON_FINITE
    np.testing.assert_array_equal(found.fault[1:], [Fault.OUTSIDE, Fault.UNSETTLED, 0])
    np.testing.assert_array_equal(found.poses[3, :, :2], clean.poses[3, :, :2])
    np.testing.assert_allclose(found.poses[1, :, 1:], clean.poses[1, :, 1:], atol=1e-6)


def test_a_fall_too_fast_a_stopped_hand_and_an_object_inside_another_are_faults(
    engine: MjxEngine, settled: tuple[Scene, np.ndarray]
) -> None:
    scene, poses = settled
    cubes = scene.replace(shape=np.where(scene.shape >= 0, CLASS["cuboid"], ABSENT), mass=np.full_like(scene.mass, 0.1))
    cubes.mass[1, 1] = 60.0
    bad = np.array(poses)
    bad[..., 2:] = [0.025, 1, 0, 0, 0]
    cubes = cubes.replace(size=np.full_like(cubes.size, 0.05))
    inside = np.array(bad)
    inside[3, 1, :2] = inside[3, 0, :2] + np.array([0.04, 0])
    bad[0, 1, 2] = 2.0  # ends at 5.4 m/s
    high = np.tile(np.array([0.1, 0, 0.2, 0, GRIPPER.push_gap], np.float32), (BATCH, 1))
    low = np.array(high)
    high[1, :2] = low[1, :2] = bad[1, 1, :2]
    low[1, 2] = 0.01
    down = Trajectory(np.tile(np.float32([0, 0.3]), (BATCH, 1)), np.stack([high, low], 1))
    found = engine.simulate(cubes, bad, down, np.array([0.55]))
    faults = (Fault.SPEED, Fault.GRIPPER_SHORT)
    np.testing.assert_array_equal([[bool(f & each) for each in faults] for f in found.fault], np.eye(4, 2, dtype=bool))
    depth = [bool(f & Fault.PENETRATION) for f in primitives.settle(engine, cubes, inside, duration=0.01).fault]
    assert depth == [False, False, False, True]
    bad[0, 1, 2] = 1.1  # ends at 4.6 m/s; what starts inside another is pushed apart
    bad[3, 1, :2] = bad[3, 0, :2] + np.array([0.03, 0])
    for fence, wanted in ((0.0, True), (0.55, False)):
        found = primitives.settle(engine, cubes, bad, duration=0.55, fence=fence)
        assert [bool(f & Fault.PENETRATION) for f in found.fault] == [wanted, False, False, False]


def test_a_scene_does_not_depend_on_its_batch(engine: MjxEngine, settled: tuple[Scene, np.ndarray]) -> None:
    scene, poses = settled
    scene_5, poses_5 = jax.tree.map(lambda leaf: np.concatenate([leaf[::-1], leaf[:1]]), (scene, poses))
    chunked = MjxEngine(engine.config, chunk=BATCH)
    chunked.programs = engine.programs
    five = primitives.settle(chunked, scene_5, poses_5, duration=0.1)
    four = primitives.settle(engine, scene, poses, duration=0.1)
    assert five.poses.shape == (5, 1, SLOTS, 7)
    np.testing.assert_allclose(five.poses[:4], four.poses[::-1], atol=1e-5)
    np.testing.assert_allclose(five.poses[4], four.poses[0], atol=1e-5)


def test_on_its_device_it_returns_the_same_arrays_and_can_be_traced(
    engine: MjxEngine, settled: tuple[Scene, np.ndarray]
) -> None:
    scene, poses = jax.tree.map(jnp.asarray, settled)
    queued = OnDevice(engine)
    assert engine.on_device() is None, "a CPU"
    found = primitives.settle(queued, scene, poses, duration=0.05)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(found))
    wanted = primitives.settle(engine, *settled, duration=0.05)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(found), wanted)
    traced = jax.eval_shape(lambda at: primitives.settle(queued, scene, at, duration=0.05), poses)
    assert traced.poses.shape == found.poses.shape


def test_a_fence_pushes_as_in_mujoco_c(
    engine: MjxEngine, reference: NativeEngine, settled: tuple[Scene, np.ndarray]
) -> None:
    scene, poses = settled
    far = np.where(scene.shape[..., None] >= 0, poses + np.array([0.2, 0, 0, 0, 0, 0, 0]), poses).astype(np.float32)
    found = primitives.settle(engine, scene, far, duration=0.1, fence=0.05)
    wanted = primitives.settle(reference, scene, far, duration=0.1, fence=0.05)
    np.testing.assert_allclose(found.poses[..., :3], wanted.poses[..., :3], atol=POSITION_TOLERANCE)
    assert np.abs(far - wanted.poses[:, 0])[..., 0].max() > 0.02


@pytest.mark.parametrize("solver", ["xla", "warp"])
def test_a_batch_is_shared_by_all_devices_and_each_scene_comes_back_in_its_place(
    solver: str, tmp_path: pathlib.Path
) -> None:
    script = tmp_path / "devices.py"
    script.write_text(FOUR_DEVICES)
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "JAX_PLATFORMS": "cpu"}
    command, env = [sys.executable, script, solver], os.environ | flags
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_contacts_that_are_left_out_are_a_fault() -> None:
    cramped = MjxEngine(dataclasses.replace(mjx.DEFAULTS, contact_points=(2, 0)))
    size, flat = np.full((1, 1, 3), 0.05, np.float32), np.full((1, 1), 0.35, np.float32)
    box = Scene(np.zeros((1, 1), np.int32), size, size, flat, flat)
    pose = np.array([[[0, 0, 0.0249, 1, 0, 0, 0]]], np.float32)
    assert primitives.settle(cramped, box, pose, duration=0.02).fault[0] & Fault.CAPACITY


def test_pairs_that_are_left_out_are_a_fault(engine: MjxEngine) -> None:
    few = MjxEngine(dataclasses.replace(mjx.DEFAULTS, geom_pairs=(1, 0)))
    size, full = np.full((BATCH, SLOTS, 3), 0.05, np.float32), np.full((BATCH, SLOTS), 0.35, np.float32)
    boxes = Scene(np.zeros((BATCH, SLOTS), np.int32), size, np.zeros_like(size), full, full)
    boxes.shape[1:, 1:] = ABSENT  # only the first scene has a pair, in fact two
    row = np.tile(np.array([0, 0, 0.025, 1, 0, 0, 0], np.float32), (BATCH, SLOTS, 1))
    row[..., 0] = 0.0502 * np.arange(SLOTS)
    for each, wanted in ((few, [True, False, False, False]), (engine, [False] * BATCH)):
        fault = primitives.settle(each, boxes, row, duration=0.02).fault
        assert ((fault & Fault.CAPACITY) > 0).tolist() == wanted


def test_a_timestep_that_does_not_divide_the_control_period_is_refused() -> None:
    with pytest.raises(UserError, match=r"timestep 0\.004"):
        MjxEngine(dataclasses.replace(mjx.DEFAULTS, timestep=0.004))
