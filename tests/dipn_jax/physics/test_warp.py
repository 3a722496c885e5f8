"""MuJoCo Warp: refused in one line where it cannot run, and equal to the native engine where it can."""

import sys
from typing import Any

import jax
import numpy as np
import pytest

from dipn_jax import physics, structs
from dipn_jax.engine import PhysicsConfig
from dipn_jax.errors import UserError
from dipn_jax.physics import warp
from dipn_jax.structs import Fault, Scene, Trajectory
from dipn_jax.workspace import GRIPPER, WORKSPACE
from dipn_jax.world import primitives


def test_without_its_packages_it_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(UserError, match=r"engine warp: .*dipn-jax\[warp\]") as error:
        physics.make_engine("warp")
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def warp_engine() -> Any:
    return physics.make_engine("warp")


@pytest.mark.slow
@pytest.mark.parametrize("objects", [5, 2], ids=["sparse", "dense"])
def test_it_follows_the_native_engine(warp_engine: Any, engine: Any, settled: Any, objects: int) -> None:
    scene = jax.tree.map(lambda leaf: leaf[:2, :objects], settled.scene)
    poses = settled.poses[:2, :objects].copy()
    poses[:, :, 2] += 0.01
    found = primitives.settle(warp_engine, scene, poses, duration=0.06)
    assert warp_engine._worlds.model.is_sparse == (objects == 5)
    wanted = primitives.settle(engine, scene, poses, duration=0.06)
    np.testing.assert_allclose(found.poses[..., :3], wanted.poses[..., :3], atol=1e-4)
    np.testing.assert_array_equal(found.fault & ~Fault.UNSETTLED, wanted.fault & ~Fault.UNSETTLED)


@pytest.mark.slow
def test_a_position_that_is_not_finite_or_outside_is_a_fault_of_its_own_episode(warp_engine: Any, settled: Any) -> None:
    scene, poses = structs.take(settled.scene, np.array([0, 1, 1])), settled.poses[[0, 1, 1]].copy()
    poses[0, 0, 2] = np.nan
    poses[1, 1, 0] = WORKSPACE.half + 0.01
    fault = primitives.settle(warp_engine, scene, poses, duration=0.02).fault
    assert fault[0] & Fault.NON_FINITE
    assert fault[1] & ~Fault.UNSETTLED == Fault.OUTSIDE
    assert fault[2] & ~Fault.UNSETTLED == 0


@pytest.mark.slow
@pytest.mark.parametrize("room", [(1, 1, 64), (16, 4, 1)], ids=["contacts", "rows"])
def test_lack_of_room_is_a_fault(settled: Any, room: tuple[int, int, int]) -> None:
    scene, poses = structs.take(settled.scene, slice(0, 2)), settled.poses[:2]
    fault = primitives.settle(warp.WarpEngine(room=room), scene, poses, duration=0.01).fault
    assert (fault & Fault.CAPACITY).any()


@pytest.mark.parametrize("options", [{"jacobian": "thin"}, {"chunk": 0}, {"room": (16, 0, 64)}, {"awake": 2}])
def test_settings_that_cannot_be_are_refused_in_one_line(options: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"engine warp: .*want") as error:
        warp.WarpEngine(**options)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_an_object_inside_another_is_a_fault(warp_engine: Any, settled: Any) -> None:
    scene, poses = structs.take(settled.scene, slice(0, 2)), settled.poses[:2].copy()
    cubes = scene.replace(shape=np.zeros_like(scene.shape), size=np.full_like(scene.size, 0.05))
    poses[..., 2:] = [0.025, 1, 0, 0, 0]
    poses[..., :2] = np.array([[-0.15, 0], [-0.08, 0], [0, 0], [0.07, 0], [0.15, 0]])
    poses[1, 1, :2] = [-0.12, 0]
    fault = primitives.settle(warp_engine, cubes, poses, duration=0.01).fault
    assert [bool(f & Fault.PENETRATION) for f in fault] == [False, True]


@pytest.mark.slow
def test_objects_asleep_wake_when_they_are_touched(warp_engine: Any) -> None:
    """The gripper pushes one cube against another; three rest, in the second scene two of them inside one another."""
    poses = np.tile(np.float32([0, 0, 0.025, 1, 0, 0, 0]), (2, 5, 1))
    poses[..., :2] = [[0, 0], [0.06, 0], [-0.1, 0.1], [0, 0.15], [0.1, 0.15]]
    poses[1, 4, 0] = 0.044
    cubes = Scene(np.zeros((2, 5), int), *np.full((2, 2, 5, 3), 0.05, np.float32), *np.full((2, 2, 5), 0.3, np.float32))
    path = np.float32([[x, 0, GRIPPER.push_tip, np.pi / 2, GRIPPER.push_gap] for x in (-0.05, 0)])
    paths = Trajectory(np.tile(np.float32([0, 0.3]), (2, 1)), np.tile(path, (2, 1, 1)))
    asleep = [warp.WarpEngine(PhysicsConfig(sleep=1e-3), awake=count) for count in (1, 2)]
    wanted, cramped, found = (e.simulate(cubes, poses, paths, np.array([0.3])) for e in (warp_engine, *asleep))
    assert (found.poses[:, 0, :2, 0] - poses[:, :2, 0] > 0.005).all()
    np.testing.assert_allclose(found.poses[0, 0, :, :3], wanted.poses[0, 0, :, :3], atol=1e-3)
    np.testing.assert_array_equal(found.poses[:, 0, 2:], poses[:, 2:])
    np.testing.assert_array_equal(found.fault, [wanted.fault[0], Fault.PENETRATION])
    assert (cramped.fault & Fault.CAPACITY).all()
