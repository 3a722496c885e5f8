"""Episodes made on the device are those made on the host, and nothing between drop and last pose waits for the host."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.datagen import episodes, generate, on_device

from dipn_jax import batching
from dipn_jax.engine import DeviceEngine, Engine
from dipn_jax.physics.native import NativeEngine
from dipn_jax.storage import codec
from dipn_jax.structs import Fault, Push, Rollout, Scene
from dipn_jax.world import scenes

CONFIG = scenes.SceneConfig(slots=3, counts=(0.3, 0.3, 0.4))
COUNT = 12


class Unsteady:
    """MuJoCo C, where dropped scenes whose first object is slippery do not come to rest."""

    def __init__(self, engine: NativeEngine) -> None:
        self.engine, self.name, self.config, self.batch = engine, engine.name, engine.config, engine.batch

    def simulate(self, scene: Scene, *args: Any, **named: Any) -> Rollout:
        rollout = self.engine.simulate(*jax.device_get((scene, *args)), **named)
        slippery = (np.asarray(scene.friction)[:, 0] < 0.32) & (named.get("fence", 0) > 0)
        return rollout.replace(fault=np.where(slippery, int(Fault.UNSETTLED), rollout.fault).astype(np.int32))

    def stop(self) -> None:
        raise NotImplementedError


class OnDevice(Unsteady):
    """The same as an engine that returns arrays of the device."""

    def simulate(self, scene: Scene, *args: Any, **named: Any) -> Rollout:
        return jax.tree.map(jnp.asarray, super().simulate(scene, *args, **named))


class Traceable:
    """An engine without physics, of operations that can be traced."""

    name, batch = "none", 64

    def simulate(self, scene: Any, poses: Any, trajectories: Any, samples: Any, **_: Any) -> Rollout:
        at = poses[:, None].repeat(len(samples), 1) + trajectories.target[:, :1, None, :1]
        gripper = trajectories.target[:, :1].repeat(len(samples), 1)
        return Rollout(at, gripper, (poses[:, 0, 0] > 0.1).astype(jnp.int32))


def _require_equal(found: Any, wanted: Any) -> None:
    """Compare episodes: a value in the middle between two quanta may be rounded to the other, which moves the rest."""
    for (path, one), other in zip(jax.tree.leaves_with_path(found), jax.tree.leaves(wanted), strict=True):
        exact = np.asarray(other).dtype.kind != "f"
        np.testing.assert_allclose(one, other, rtol=0, atol=0 if exact else 1e-5, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize("distances", [(0.1,), (0.03, 0.06)])
def test_pushes_are_those_of_the_host(
    engine: NativeEngine, distances: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    aim = episodes.aim_pushes

    def aiming(*args: Any, **named: Any) -> tuple[Push, jax.Array]:
        pushes, feasible = aim(*args, **named)
        return pushes, feasible & (pushes.angle < 1.0)

    monkeypatch.setattr(episodes, "aim_pushes", aiming)
    key, sizes = jax.random.key(5), {"count": COUNT, "actions": 2, "distances": distances}
    found = on_device.push_batch(key, OnDevice(engine), CONFIG, **sizes)  # type: ignore[arg-type]
    wanted = episodes.push_batch(key, Unsteady(engine), CONFIG, **sizes)  # type: ignore[arg-type]
    assert found.counts == wanted.counts
    assert wanted.counts["settle_unsettled"] and wanted.counts["infeasible_pushes"], "nothing was left out"
    _require_equal(found.episodes, wanted.episodes)


def test_grasps_are_those_of_the_host(engine: NativeEngine) -> None:
    key, sizes = jax.random.key(5), {"count": COUNT, "actions": 2}
    found = on_device.grasp_batch(key, OnDevice(engine), CONFIG, **sizes)  # type: ignore[arg-type]
    wanted = episodes.grasp_batch(key, Unsteady(engine), CONFIG, **sizes)  # type: ignore[arg-type]
    assert found.counts == wanted.counts and wanted.counts["settle_unsettled"] and found.episodes.held.any()
    _require_equal(found.episodes, wanted.episodes)


def test_nothing_waits_for_the_host() -> None:
    engine: Any = Traceable()
    for make, sizes in (
        (on_device.push_episodes, {"actions": 2, "distances": (0.1,)}),
        (on_device.grasp_episodes, {"actions": 2, "guide": None}),
    ):
        made = functools.partial(make, engine=engine, config=CONFIG, count=4, **sizes)
        assert jax.eval_shape(made, jax.random.key(0))[0].fault.shape == (8,)


def test_without_a_usable_scene_there_is_no_episode() -> None:
    class Faulty(Traceable):
        def simulate(self, *args: Any, **named: Any) -> Rollout:
            rollout = super().simulate(*args, **named)
            return rollout.replace(fault=jnp.ones_like(rollout.fault))

    batch = on_device.push_batch(jax.random.key(0), Faulty(), CONFIG, count=COUNT, actions=2)  # type: ignore[arg-type]
    assert batch.episodes is None and batch.counts["settle_non_finite"] == batch.counts["dropped_scenes"] == COUNT


def test_an_engine_with_one_device_makes_shards_there(engine: NativeEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    class Device(Unsteady):
        several = False

        def on_device(self) -> Engine | None:
            return None if self.several else OnDevice(self.engine)  # type: ignore[return-value]

    used: list[Any] = []
    for module in (on_device, episodes):
        monkeypatch.setattr(module, "push_batch", lambda key, engine, *_, **__: used.append(engine))
    job = generate.Job(kind="push", scene=CONFIG, episodes=4, seed=0, shard_size=4, actions=1, engine="native")
    device = Device(engine)
    several = Device(engine)
    several.several = True
    assert isinstance(device, DeviceEngine) and not isinstance(engine, DeviceEngine)
    for each in (device, several, engine):
        generate._maker(job, each, None)(jax.random.key(0), count=1)  # type: ignore[arg-type]
    assert isinstance(used[0], OnDevice) and used[1:] == [several, engine]


def test_what_is_rounded_on_the_device_is_what_is_stored() -> None:
    """Multiples of a quantum up to 2^24 of them; XLA would divide by a constant in another way."""
    whole = np.arange(2**20, dtype=np.float32) * 16
    rounded = jax.jit(codec.rounded_on_device)
    for name, quantum in codec.QUANTA.items():
        assert 1 / codec.STEPS[name] == pytest.approx(quantum)
        found = rounded({name: whole / codec.STEPS[name]}, {f"['{name}']": codec.STEPS[name]})[name]
        np.testing.assert_array_equal(found, (whole.astype(np.float64) * quantum).astype(np.float32))


def test_rows_are_taken_together_on_an_accelerator(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int | None] = []
    own = jax.lax.map

    def spied(function: Any, rows: Any, *, batch_size: int | None) -> Any:
        seen.append(batch_size)
        return own(function, rows, batch_size=batch_size)

    monkeypatch.setattr(jax.lax, "map", spied)
    rows = jnp.arange(20.0)
    np.testing.assert_array_equal(batching.each_row(jnp.sin, rows), jnp.sin(rows))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    np.testing.assert_allclose(batching.each_row(jnp.sin, rows), jnp.sin(rows), rtol=1e-6)
    assert seen == [None, batching.SMALL_BATCH]
