"""MuJoCo Warp: refused in one line where it cannot run, and the native engine's equal where it can."""

import sys
from typing import Any

import numpy as np
import pytest

from dipn_jax import physics, primitives, structs
from dipn_jax.errors import UserError
from dipn_jax.structs import Fault


def test_without_its_packages_it_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(UserError, match=r"engine warp: .*dipn-jax\[warp\]") as error:
        physics.make_engine("warp")
    assert "\n" not in str(error.value)


def test_it_follows_the_native_engine(engine: Any, settled: Any) -> None:
    pytest.importorskip("warp")
    scene, poses = structs.take(settled.scene, slice(0, 2)), settled.poses[:2].copy()
    poses[:, :, 2] += 0.01
    found = primitives.settle(physics.make_engine("warp"), scene, poses, duration=0.06)
    wanted = primitives.settle(engine, scene, poses, duration=0.06)
    np.testing.assert_allclose(found.poses[..., :3], wanted.poses[..., :3], atol=1e-4)
    np.testing.assert_array_equal(found.fault & ~Fault.UNSETTLED, wanted.fault & ~Fault.UNSETTLED)
