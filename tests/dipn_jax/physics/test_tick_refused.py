"""Where the kernel of a control period cannot be used: one line says why."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import sys
from typing import Any

import numpy as np
import pytest
from eventful import scenes_with_control

from dipn_jax import physics
from dipn_jax.errors import UserError
from dipn_jax.physics import mjx, tick
from dipn_jax.physics.mjx_program import Program
from dipn_jax.structs import Scene
from dipn_jax.world import primitives

pytestmark = pytest.mark.slow


def test_without_warp_it_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(UserError, match=r"solver warp: .*dipn-jax\[warp\].* or solver xla$") as error:
        physics.make_engine("mjx_warp")
    assert "\n" not in str(error.value)


def test_a_gpu_that_warp_does_not_find_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import warp

    for found in (True, False):
        monkeypatch.setattr(warp, "is_cuda_available", lambda found=found: found)
        tick.check("cpu")
        with contextlib.nullcontext() if found else pytest.raises(UserError, match="no CUDA device here; want a newer"):
            tick.check("gpu")


@pytest.mark.parametrize("error", [Exception("CUDA kernel build failed with error code 5"), RuntimeError("no"), None])
def test_a_kernel_that_cannot_be_compiled_is_one_line(error: Exception | None, monkeypatch: pytest.MonkeyPatch) -> None:
    from warp._src.context import Module

    def load(*_: Any, **__: Any) -> None:
        if error is not None:
            raise error

    monkeypatch.setattr(Module, "load", load)
    scene, poses, _ = scenes_with_control()
    engine = mjx.MjxEngine(dataclasses.replace(mjx.DEFAULTS, solver="warp", ls_iterations=9))  # a call of its own
    said = str(error) if error is not None else "Failed to load Warp module .*"
    with pytest.raises(UserError) as raised:
        primitives.settle(engine, scene, poses, duration=0.01)
    wanted = f"solver warp: {said}; want a device that Warp compiles for, or solver xla"
    assert re.fullmatch(wanted, str(raised.value))  # without what JAX notes of its frames


def test_what_there_is_no_kernel_for_is_refused() -> None:
    assert [tick.capacity(*size) for size in ((7, 80), (8, 80), (14, 112))] == [(8, 80), (15, 112), (15, 112)]
    for slots, contacts, said in ((15, 112, "112"), (7, 113, "113"), (7, -1, "all")):
        with pytest.raises(UserError, match=f"object slots and {said} contacts a scene; want at most 14 and 112"):
            tick.capacity(slots, contacts)
    size, full = np.full((1, 15, 3), 0.05, np.float32), np.full((1, 15), 0.35, np.float32)
    crowd = Scene(np.zeros((1, 15), np.int32), size, size, full, full)
    with pytest.raises(UserError, match="15 object slots"):
        primitives.settle(physics.make_engine("mjx_warp"), crowd, np.zeros((1, 15, 7), np.float32), duration=0.01)
    with pytest.raises(UserError, match="solver warp: the cone is pyramidal; want elliptic, or solver xla"):
        Program(dataclasses.replace(mjx.DEFAULTS, solver="warp", cone="pyramidal"), 1, 4)


def test_it_is_an_option_and_runs_where_warp_does() -> None:
    assert physics.make_engine("mjx").config == mjx.DEFAULTS and mjx.DEFAULTS.solver == "xla"
    with pytest.raises(UserError, match="solver warp: JAX computes on tpu; want cpu or gpu, or solver xla"):
        tick.check("tpu")
