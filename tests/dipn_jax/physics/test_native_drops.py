"""What the C engine computes of a drop."""

from typing import Any, ClassVar

import jax
import numpy as np
import pytest

from dipn_jax.physics import native
from dipn_jax.world import primitives, scenes


class _Counted(native._Worlds):
    """Worlds that note how many steps each control period has, and of how many scenes."""

    steps: ClassVar[list[tuple[float, int, int]]] = []
    all_of_them = False

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        if self.all_of_them:
            self._still = np.zeros_like(self._still)
        original = self._batch.step

        def step(ids: Any, nstep: int) -> None:
            assert {one.opt.timestep for one in self._engine._models.values()} == {0.002}  # other threads have them
            self.steps.append((self._models[0].opt.timestep, nstep, len(self._models) if ids is None else len(ids)))
            original(ids, nstep=nstep)

        self._batch.step = step
        try:
            return super().advance()
        finally:
            self._batch.step = original


def test_a_drop_has_larger_steps_first_and_what_rests_is_not_computed(
    engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = scenes.SceneConfig(slots=3, counts=(0.5, 0.0, 0.5))  # also empty slots, whose bodies fall for ever
    scene, poses = jax.device_get(
        jax.vmap(lambda key: scenes.random_scene(key, config=few))(jax.random.split(jax.random.key(5), 4))
    )
    monkeypatch.setattr(native, "_Worlds", _Counted)
    monkeypatch.setattr(_Counted, "steps", [])
    ours = primitives.settle(engine, scene, poses, fence=primitives.FENCE_TIME)
    steps = _Counted.steps.copy()
    assert [step[:2] for step in steps] == [(0.01 / 3, 3)] * 200 + [(0.002, 5)] * 50
    assert steps[0][2] == 4 and steps[-1][2] == 0
    _Counted.steps.clear()
    monkeypatch.setattr(_Counted, "all_of_them", True)
    every = primitives.settle(engine, scene, poses, fence=primitives.FENCE_TIME)
    assert {step[2] for step in _Counted.steps} == {4}
    np.testing.assert_array_equal(ours.poses, every.poses)
    np.testing.assert_array_equal(ours.fault, every.fault)
    _Counted.steps.clear()
    primitives.settle(engine, scene, ours.poses[:, -1], duration=0.02)
    assert [step[:2] for step in _Counted.steps] == [(0.002, 5)] * 2  # no drop
