"""The C engine, and the primitives executed on it."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dipn_jax.datagen import isolated

from dipn_jax import physics, structs
from dipn_jax.engine import PhysicsConfig, Stopped
from dipn_jax.errors import UserError
from dipn_jax.physics import native
from dipn_jax.structs import Fault, Grasp, Push, Scene
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import clutter, model, primitives, scenes, shapes


def one_of_each(slots: int = 2) -> tuple[Scene, np.ndarray]:
    """Return five scenes, each with one object of another class at rest in the middle and the other slots empty."""
    count = len(shapes.CLASSES)
    shape = np.full((count, slots), -1, np.int32)
    shape[:, 0] = np.arange(count)
    size = np.tile(np.array([0.05, 0.05, 0.05], np.float32), (count, slots, 1))
    mass = np.full((count, slots), 0.05, np.float32)
    scene = Scene(shape, size, np.zeros_like(size), mass, np.full((count, slots), 0.35, np.float32))
    poses = np.tile(np.asarray(scenes.parked(slots)), (count, 1, 1))
    poses[:, 0] = [0, 0, 0.03, 1, 0, 0, 0]
    return scene, poses


@pytest.fixture(scope="module")
def resting(engine: Any) -> tuple[Scene, np.ndarray]:
    scene, poses = one_of_each()
    rollout = primitives.settle(engine, scene, poses)
    assert not rollout.fault.any()
    return scene, rollout.poses[:, -1]


def _pushes(count: int, distance: float = 0.1) -> Push:
    return Push(
        np.tile([[-0.07, 0.0]], (count, 1)).astype(np.float32),
        np.zeros(count, np.float32),
        np.full(count, distance, np.float32),
    )


def test_every_class_comes_to_rest_on_the_table(resting: Any) -> None:
    scene, poses = resting
    for i in range(len(poses)):
        hull = shapes.hull(jnp.asarray(scene.shape[i, 0]), jnp.asarray(scene.size[i, 0]))
        from dipn_jax.geometry import quat_to_matrix

        corners = hull.vertices[hull.alive].reshape(-1, 3) @ quat_to_matrix(poses[i, 0, 3:]).T + poses[i, 0, :3]
        assert abs(corners[:, 2].min()) < 5e-4


def test_a_push_moves_the_object_by_its_remaining_length(engine: Any, resting: Any) -> None:
    scene, poses = resting
    rollout = primitives.push(engine, scene, poses, _pushes(5))
    assert rollout.poses.shape == (5, 12, 2, 7)
    moved = rollout.poses[:, 10, 0, 0] - poses[:, 0, 0]
    # the front face travels from -60 to +40 mm; objects are 50 mm wide, from -25 mm: 65 mm, cubes do not roll
    assert abs(moved[0] - 0.065) < 0.003
    assert (moved > 0.03).all()
    travel = rollout.gripper[:, :11, 0] - rollout.gripper[:, :1, 0]
    np.testing.assert_allclose(travel, np.tile(np.arange(11) * 0.01, (5, 1)), atol=2e-3)


def test_push_distance_is_a_value_not_a_program(engine: Any, resting: Any) -> None:
    scene, poses = resting
    rollout = primitives.push(engine, scene, poses, _pushes(5, distance=0.06))
    np.testing.assert_allclose(rollout.gripper[:, 10, 0] - rollout.gripper[:, 0, 0], 0.06, atol=2e-3)


def test_a_centred_grasp_of_every_class_holds(engine: Any, resting: Any) -> None:
    scene, poses = resting
    grasps = Grasp(
        np.zeros((5, 2), np.float32) + poses[:, 0, :2], np.zeros(5, np.float32), np.full(5, 0.02, np.float32)
    )
    _, outcome = primitives.grasp(engine, scene, poses, grasps)
    np.testing.assert_array_equal(outcome.held[:, 0], True)
    assert not outcome.held[:, 1].any(), "an empty slot is never held"


def test_a_grasp_beside_the_object_holds_nothing(engine: Any, resting: Any) -> None:
    scene, poses = resting
    away = np.tile(np.array([[0.15, 0.0]], np.float32), (5, 1))
    _, outcome = primitives.grasp(
        engine, scene, poses, Grasp(away, np.zeros(5, np.float32), np.full(5, 0.02, np.float32))
    )
    assert not outcome.success.any()


def test_results_do_not_depend_on_threads_or_neighbours(settled: Any) -> None:
    one, two = native.NativeEngine(threads=1), native.NativeEngine(threads=2)
    pushes = _pushes(6)
    a = primitives.push(one, settled.scene, settled.poses, pushes)
    b = primitives.push(two, settled.scene, settled.poses, pushes)
    np.testing.assert_array_equal(a.poses, b.poses)
    alone = primitives.push(
        one, structs.take(settled.scene, slice(2, 3)), settled.poses[2:3], structs.take(pushes, slice(2, 3))
    )
    np.testing.assert_array_equal(alone.poses[0], a.poses[2])


def test_faults_are_data_of_their_own_episode(engine: Any, resting: Any) -> None:
    scene, poses = resting
    poses = poses.copy()
    poses[0, 0, 0] = 0.3  # outside
    poses[1, 0, 2] = 0.4  # still falling
    poses[2, 0, 2] -= 0.03  # into the table; MuJoCo throws it out again within a few hundredths of a second
    rollout = primitives.settle(engine, scene, poses, duration=0.01)
    assert rollout.fault[0] & Fault.OUTSIDE
    assert rollout.fault[1] & Fault.UNSETTLED
    assert rollout.fault[2] & Fault.PENETRATION
    assert rollout.fault[3] == 0 and rollout.fault[4] == 0
    assert Fault.count(rollout.fault)["outside"] == 1


def test_a_spike_of_speed_and_an_object_inside_another_are_faults(engine: Any, resting: Any) -> None:
    scene, poses = jax.tree.map(lambda leaf: np.repeat(leaf[:1], 3, 0), resting)
    cubes = scene.replace(shape=np.zeros((3, 2), np.int32))
    above, inside, beside = [0.15, 0, 2.0], [0.04, 0, 0], [0.06, 0, 0]  # a fall of 2 m ends at 6 m/s
    poses[:, 1] = poses[:, 0]
    poses[:, 1, :3] += np.array([above, inside, beside], np.float32)
    fallen = primitives.settle(engine, cubes, poses, duration=0.6)
    assert [bool(f & Fault.SPEED) for f in fallen.fault] == [True, False, False]
    at_once = primitives.settle(engine, cubes, poses, duration=0.0)
    assert [bool(f & Fault.PENETRATION) for f in at_once.fault] == [False, True, False]


@pytest.mark.parametrize(("fence", "fault"), [(0.0, Fault.PENETRATION), (0.6, 0)])
def test_a_deep_contact_on_the_way_is_a_fault_except_in_falling_heaps_and_at_the_start(
    engine: Any, resting: Any, fence: float, fault: int
) -> None:
    scene, poses = jax.tree.map(lambda leaf: np.repeat(leaf[:1], 3, 0), resting)
    cubes = scene.replace(shape=np.zeros((3, 2), np.int32), size=np.full((3, 2, 3), 0.05, np.float32))
    poses[..., 2:] = [0.025, 1, 0, 0, 0]
    poses[:, 1, :3] = poses[:, 0, :3] + np.array([[0.1, 0, 1.1], [0.1, 0, 0.1], [0.03, 0, 0]])  # ends at 4.6 m/s
    found = primitives.settle(engine, cubes, poses, duration=0.6, fence=fence)
    np.testing.assert_array_equal(found.fault & ~Fault.UNSETTLED, [fault, 0, 0])
    assert np.abs(found.poses[2, 0, 1, 0] - found.poses[2, 0, 0, 0]) > 0.0495  # pushed apart


def test_an_object_inside_another_stays_a_fault_when_it_sleeps(engine: Any) -> None:
    size, flat = np.full((1, 2, 3), 0.05, np.float32), np.full((1, 2), 0.35, np.float32)
    cubes = Scene(np.zeros((1, 2), np.int32), size, size, flat / 7, flat)
    poses = np.zeros((1, 2, 7), np.float32)
    poses[..., 2], poses[..., 3], poses[0, 1, 2] = 0.025, 1, 0.075
    stacked = primitives.settle(engine, cubes, poses, duration=1.0)
    assert stacked.fault[0] == 0
    models = engine._compile(structs.take(cubes, slice(0, 1)))
    qpos = np.concatenate([[0, 0, 2, 0, 0, 0], stacked.poses[0, 0].reshape(-1)])[None]
    assert 1e-6 < native.contact_depths(models, qpos)[0] < 1e-3
    qpos[0, 6 + 7 + 2] -= 0.01
    assert native.contact_depths(models, qpos)[0] > 0.009


def test_a_position_that_is_not_finite_is_a_fault_of_its_own_episode(engine: Any, resting: Any) -> None:
    scene, poses = resting
    bad = np.array(poses)
    bad[1, 0, 2] = np.nan
    bad[2, 1] = np.nan  # an empty slot
    fault = primitives.settle(engine, scene, bad, duration=0.05).fault
    assert fault[1] & Fault.NON_FINITE
    assert not fault[[0, 2, 3, 4]].any()


def test_lack_of_room_is_a_fault(engine: Any, resting: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, poses = resting
    original = model.mjcf
    monkeypatch.setattr(
        model, "mjcf", lambda *a, **k: original(*a, **k).replace("<custom>", '<size memory="8K"/><custom>')
    )
    cramped = primitives.settle(native.NativeEngine(), scene, poses, duration=0.05)
    assert (cramped.fault == Fault.CAPACITY).all()


def test_a_diverged_simulation_is_not_reset_silently(resting: Any) -> None:
    scene, _ = resting
    text = model.mjcf(structs.take(scene, 0), config=PhysicsConfig())
    spec = mujoco.MjModel.from_xml_string(text)
    assert spec.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


def test_a_grasp_that_cannot_hold_does_not(engine: Any, rng: np.random.Generator) -> None:
    assert isolated.shares_of_long(engine, rng, 4) == {"too_wide": 0.0, "on_top": 0.0, "heavy": 1.0}


def test_every_item_that_fits_is_held(engine: Any, rng: np.random.Generator) -> None:
    for item in shapes.CATALOGUE[::4]:
        share, tries = isolated.share_held(engine, rng, item, 4)
        assert share >= 0.75 and tries == 4, item


def test_two_objects_side_by_side_are_both_held(engine: Any) -> None:
    size = np.full((1, 3, 3), 0.05, np.float32)
    size[..., 0] = 0.025
    flat = np.full((1, 3), 0.35, np.float32)
    scene = Scene(np.zeros((1, 3), np.int32), size, np.zeros_like(size), flat / 7, flat)
    poses = np.zeros((1, 3, 7), np.float32)
    poses[..., :3] = [[[-0.013, 0, 0.025], [0.013, 0, 0.025], [0.15, 0, 0.025]]]
    poses[..., 3] = 1
    _, outcome = primitives.grasp(
        engine, scene, poses, Grasp(np.zeros((1, 2), np.float32), np.zeros(1, np.float32), np.full(1, 0.02, np.float32))
    )
    np.testing.assert_array_equal(outcome.held, [[True, True, False]])


def test_a_gripper_that_is_stopped_is_a_fault(engine: Any, resting: Any) -> None:
    scene, poses = resting
    heavy = scene.replace(mass=np.full_like(scene.mass, 60.0))
    stopped, free = (primitives.push(engine, each, poses, _pushes(5)) for each in (heavy, scene))
    assert (stopped.fault & Fault.GRIPPER_SHORT).any(), "it is lifted in the end, where it should be"
    assert not (free.fault & Fault.GRIPPER_SHORT).any()


def test_an_object_that_is_pushed_over_is_flagged(engine: Any) -> None:
    size = np.tile(np.array([0.025, 0.05, 0.1], np.float32), (2, 1, 1))  # upright, one side narrow
    friction = np.array([[2.0], [0.05]], np.float32)  # one sticks to the table, one slides
    scene = Scene(np.zeros((2, 1), np.int32), size, np.zeros_like(size), np.full((2, 1), 0.06, np.float32), friction)
    poses = np.zeros((2, 1, 7), np.float32)
    poses[..., 2], poses[..., 3] = 0.05, 1
    rollout = primitives.push(engine, scene, poses, _pushes(2))
    np.testing.assert_array_equal(np.asarray(rollout.fault & Fault.TIPPED) > 0, [True, False])


def test_empty_slots_keep_their_pose(engine: Any, resting: Any) -> None:
    scene, poses = resting
    rollout = primitives.settle(engine, scene, poses, duration=0.1)
    np.testing.assert_allclose(rollout.poses[:, 0, 1], poses[:, 1], atol=1e-6)


def test_a_fence_keeps_objects_in_while_it_is_up(engine: Any, resting: Any) -> None:
    scene, poses = resting
    poses = poses.copy()
    poses[:, 0, :2] = [0.21, -0.22]
    free = primitives.settle(engine, scene, poses, duration=0.5)
    held = primitives.settle(engine, scene, poses, duration=0.5, fence=0.4)
    assert (np.abs(free.poses[:, 0, 0, :2]) > 0.2).all()
    assert (np.abs(held.poses[:, 0, 0, :2]) < physics.FENCE + 0.005).all()
    np.testing.assert_allclose(held.poses[:, 0, 1], poses[:, 1], atol=1e-6)


def test_thirty_objects_settle_inside(engine: Any) -> None:
    kept, counts = clutter.settled(jax.random.key(0), engine, scenes.parse_objects("30"), 4)
    assert counts["dropped_scenes"] == 4 and len(kept.fault) >= 2
    assert (np.abs(kept.poses[..., :2]) < WORKSPACE.half).all()


def test_a_stopped_engine_stops(resting: Any) -> None:
    scene, poses = resting
    engine = native.NativeEngine()
    engine.stop()
    with pytest.raises(Stopped):
        primitives.settle(engine, scene, poses)


def test_unknown_engine_is_refused() -> None:
    with pytest.raises(UserError, match="engine 'bullet'"):
        physics.make_engine("bullet")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("device", "cores", "engine"), [("cpu", 2, "native"), ("gpu", 2, "mjx"), ("gpu", 16, "native")]
)
def test_auto_is_the_faster_engine_of_the_machine(
    monkeypatch: pytest.MonkeyPatch, device: str, cores: int, engine: str
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    monkeypatch.setattr(physics, "cores", lambda: cores)
    assert physics.resolve("auto") == engine and physics.resolve("warp") == "warp"


@pytest.mark.parametrize("slots", [1, 3, 9])
def test_models_of_any_mix_share_one_layout(slots: int, rng: np.random.Generator) -> None:
    nodes = set()
    for shape in [*np.tile(np.arange(-1, 5)[:, None], slots), *rng.integers(-1, 5, (8, slots))]:
        ones = np.full(slots, 0.1, np.float32)
        scene = Scene(shape, np.full((slots, 3), 0.05), np.zeros((slots, 3)), ones, ones)
        text = model.mjcf(scene, config=native.DEFAULTS, alike=True)
        nodes.add(mujoco.MjModel.from_xml_string(text).nbvh)
    assert len(nodes) == 1
