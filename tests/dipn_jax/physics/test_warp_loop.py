"""The control loop of MuJoCo Warp on the device, against the loop on the host that the native engine runs in."""

from typing import Any

import jax
import numpy as np
import pytest

from dipn_jax import structs
from dipn_jax.physics import hosted, warp
from dipn_jax.physics.warp_worlds import Worlds
from dipn_jax.structs import Fault, Rollout, Scene, Trajectory

pytestmark = pytest.mark.slow  # compiles kernels for most of a minute

FENCE = 0.05
SAMPLES = np.array([0.0, 0.03, 0.03, 0.13])


class Stepped:
    """Worlds for `hosted.follow`: each control period is stepped from the host, with copies both ways."""

    def __init__(self, worlds: Worlds, qpos: np.ndarray) -> None:
        self.worlds, self.data, self.iterations = worlds, worlds.data, []  # type: ignore[var-annotated]
        worlds.mjw.reset_data(worlds.model, worlds.data)
        self.data.qpos.assign(qpos.astype(np.float32))
        self.qpos, self.qvel = qpos, np.zeros((len(qpos), worlds.spec.nv))
        self.ctrl, self.qfrc_applied = np.zeros((len(qpos), worlds.spec.nu)), np.zeros_like(self.qvel)

    @property
    def warning(self) -> np.ndarray:
        return self.worlds.warning

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        self.data.ctrl.assign(self.ctrl.astype(np.float32))
        self.data.qfrc_applied.assign(self.qfrc_applied.astype(np.float32))
        for _ in range(self.worlds.engine.substeps):
            self.worlds.mjw.step(self.worlds.model, self.data)
            self.iterations.append(self.data.solver_niter.numpy().copy())
        self.qpos, self.qvel = self.data.qpos.numpy().astype(float), self.data.qvel.numpy().astype(float)
        return np.zeros(0, int), np.zeros(0, int)

    def depths(self) -> np.ndarray:
        self.worlds.qpos = self.qpos
        return self.worlds.depths()

    last_depths = depths


@pytest.fixture(scope="module")
def tables(settled: Any) -> tuple[Scene, np.ndarray, Trajectory]:
    """Return five tables: as they are, one pose not a number, one object beyond the fence, a path too fast, fewer.

    The grippers come down and close.
    """
    scene, poses = structs.take(settled.scene, np.array([0, 1, 2, 0, 1])), settled.poses[[0, 1, 2, 0, 1]].copy()
    poses[1, 0, 2] = np.nan
    poses[2, 1, :2] = [0.2, -0.19]
    poses[2, 1, 2] += 0.05
    shape = np.array(scene.shape)
    shape[4, [0, 2]] = structs.ABSENT
    down = np.array([[0, 0, 0.3, 0, 0.1], [0.01, 0, 0.25, 0.1, 0.02], [0.01, 0, 0.25, 0.1, 0.02]], np.float32)
    targets = np.repeat(down[None], 5, 0)
    targets[3, 1:, :3] += [0.3, 0.2, 0.5]
    return scene.replace(shape=shape), poses, Trajectory(np.tile(np.float32([0, 0.1, 0.2]), (5, 1)), targets)


@pytest.fixture(scope="module")
def both(tables: Any) -> Any:
    """Return the rollouts and what was noted of them, on the device and on the host, and the iterations of both."""
    scene, poses, paths = tables
    engine, kept = warp.WarpEngine(), []
    found = engine.simulate(scene, poses, paths, SAMPLES, settle=True, fence=FENCE)
    worlds = engine._worlds
    assert worlds is not None
    noted = worlds.watched()

    class Watch(hosted.Watch):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            kept.append(self)

    packed, slots = hosted.pack(scene)
    start = np.take_along_axis(poses, slots[..., None], 1)
    start = np.where(packed.shape[..., None] >= 0, start, warp.parked(start.shape[1]))
    sims = Stepped(worlds, np.concatenate([hosted.controls(paths, np.zeros(1))[0], start.reshape(len(start), -1)], -1))
    with pytest.MonkeyPatch.context() as patch, engine.warp.ScopedDevice(engine.device):
        patch.setattr(hosted, "Watch", Watch)
        wanted = hosted.follow(sims, packed, slots, poses, paths, SAMPLES, settle=True, fence=FENCE)
    return (found, noted, engine.iterations), (wanted, kept[0], np.stack(sims.iterations))


def test_it_is_the_loop_on_the_host(both: tuple[tuple[Rollout, Any, Any], tuple[Rollout, Any, Any]]) -> None:
    (found, noted, _), (wanted, watch, _) = both
    np.testing.assert_allclose(found.poses, wanted.poses, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.gripper, wanted.gripper, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found.fault, wanted.fault)
    for name in ("fastest", "off", "deepest"):
        np.testing.assert_allclose(getattr(noted, name), getattr(watch, name), rtol=1e-4, atol=1e-6, err_msg=name)


def test_the_tables_show_what_there_is_to_show(both: Any) -> None:
    rollout, watch, _ = both[1]
    assert rollout.fault[1] & Fault.NON_FINITE and rollout.fault[3] & Fault.GRIPPER_SHORT
    inward = (rollout.poses[2, -1, 1] - rollout.poses[2, 0, 1])[:2] * np.array([-1, 1])
    assert (inward > 0.02).all() and watch.deepest.max() > 1e-3 and watch.fastest[2].max() > 1


def test_it_counts_the_iterations_of_the_solver(both: Any) -> None:
    found, taken = both[0][2], both[1][2]
    assert found.mean == pytest.approx(taken.mean()) and found.most == taken.max() > 1
    assert found.p95 == np.quantile(taken, 0.95, method="inverted_cdf")


def test_scenes_that_follow_in_the_same_room_are_as_in_their_own(tables: Any) -> None:
    """Those that come first are deep and fast, take more iterations, and have other shapes."""
    first, then = ((structs.take(tables[0], at), tables[1][at], structs.take(tables[2], at)) for at in ([2], [0]))
    engines = warp.WarpEngine(), warp.WarpEngine()
    engines[0].simulate(*first, SAMPLES, fence=FENCE)
    worlds = engines[0]._worlds
    rollouts = [engine.simulate(*then, SAMPLES) for engine in engines]
    assert engines[0]._worlds is worlds and engines[0].iterations == engines[1].iterations
    jax.tree.map(np.testing.assert_array_equal, *rollouts)
    noted = [engine._worlds.watched() for engine in engines]  # type: ignore[union-attr]
    for name in ("fastest", "off", "deepest"):
        np.testing.assert_array_equal(*(getattr(watch, name) for watch in noted))


def test_a_path_of_many_key_frames_is_followed(tables: Any) -> None:
    scene, poses, paths = tables
    longer = jax.tree.map(lambda leaf: np.concatenate([leaf[:, :-1], np.repeat(leaf[:, -1:], 20, 1)], 1), paths)
    engine = warp.WarpEngine()
    first, then = (engine.simulate(scene, poses, each, SAMPLES[-1:]) for each in (paths, longer))
    np.testing.assert_array_equal(first.gripper, then.gripper)
