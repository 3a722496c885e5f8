"""The stage of `on_gpu` about other settings of the accelerators' engines: what each gives, and its solver's work."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.datagen_mjx import heaps
from benchmarks.gpu_engines import heap_rate, make_ready
from benchmarks.gpu_stage import Found, NotMeasured, Size, brief, installed
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.physics import mjx, warp
from dipn_jax.structs import Fault
from dipn_jax.world import primitives

CONFIG = "config"
"""Key of a variant's changes to the `PhysicsConfig` of its engine."""
WARP: dict[str, dict[str, Any]] = {
    "warp/as_is": {},
    "warp/tolerance_1e-6": {CONFIG: {"tolerance": 1e-6}},
    "warp/iterations_15": {CONFIG: {"iterations": 15}},
    "warp/tolerance_1e-6_iterations_15": {CONFIG: {"tolerance": 1e-6, "iterations": 15}},
    "warp/line_search_15": {CONFIG: {"ls_iterations": 15}},
    "warp/sparse": {"jacobian": "sparse"},
    "warp/dense": {"jacobian": "dense"},
    "warp/sparse_tolerance_1e-6": {"jacobian": "sparse", CONFIG: {"tolerance": 1e-6}},
    "warp/asleep": {CONFIG: {"sleep": 1e-3}},
    "warp/timestep_2.5ms": {CONFIG: {"timestep": 0.0025}},
}
"""Variants of MuJoCo Warp: arguments of its engine, and changes of its configuration."""
MJX: dict[str, dict[str, Any]] = {
    "mjx/as_is": {},
    "mjx/iterations_15": {CONFIG: {"iterations": 15}},
    "mjx/half_the_contacts": {CONFIG: {"contact_points": (40, 4)}},
}
"""Variants of MJX; each compiles a program of its own."""
ALL = WARP | MJX
"""All variants by name."""


def variant(name: str, *, batch: int, timestep: float | None = None) -> Engine:
    """Return an engine with the settings of `ALL[name]`, for so many scenes at once; and a time step, if one is given.

    Raises:
      NotMeasured: the engine is not installed, or knows no such setting.
    """
    if name.startswith("warp") and not installed("warp"):
        raise NotMeasured("MuJoCo Warp is not installed; install the extra `warp`")
    kind, config = (warp.WarpEngine, warp.DEFAULTS) if name.startswith("warp") else (mjx.MjxEngine, mjx.DEFAULTS)
    options = {"chunk": batch} | {key: value for key, value in ALL[name].items() if key != CONFIG}
    changes = ({} if timestep is None else {"timestep": timestep}) | ALL[name].get(CONFIG, {})
    unknown = [key for key in options if key not in inspect.signature(kind).parameters]
    unknown += [key for key in changes if key not in {field.name for field in dataclasses.fields(config)}]
    if unknown:
        raise NotMeasured(f"not available: {kind.__name__} has no setting {unknown[0]}")
    try:
        made: Engine = kind(dataclasses.replace(config, **changes), **options)
    except (UserError, TypeError, ValueError) as error:
        raise NotMeasured(f"not available: {brief(error)}") from error
    return made


@contextlib.contextmanager
def counted() -> Iterator[list[np.ndarray]]:
    """Collect the iterations `[B]` of MuJoCo Warp's solver in the last step of every control period in this context."""
    found: list[np.ndarray] = []
    original = warp._Worlds.advance

    def advance(worlds: Any) -> tuple[np.ndarray, np.ndarray]:
        result = original(worlds)
        count = getattr(getattr(worlds, "data", None), "solver_niter", None)
        if count is not None:
            found.append(np.array(count.numpy()))
        return result

    with mock.patch.object(warp._Worlds, "advance", advance):
        yield found


def variants(size: Size) -> Found:
    """Measure each variant on falling heaps: scene seconds a second, scenes with a fault, iterations of its solver."""
    batch = size.batches[0]
    scene, poses = heaps(size.seed, batch, objects=size.objects)
    still, end = primitives.parked_trajectory(batch, size.heap_seconds), np.array([size.heap_seconds])
    rates: dict[str, float] = {}
    for name in [*list(WARP)[: size.variants], *list(MJX)[: size.variants]]:
        try:
            engine = variant(name, batch=batch, timestep=size.timestep)
            make_ready(engine, scene, poses)
            rates[name] = heap_rate(engine, scene, poses, size)
            yield f"{name}/scene_seconds", rates[name]
            with counted() as iterations:
                rollout = engine.simulate(scene, poses, still, end)
        except NotMeasured as reason:
            yield name, f"not measured: {reason}"
            continue
        except Exception as error:  # as a setting that MuJoCo Warp does not have for these models
            yield name, f"failed: {brief(error)}"
            continue
        yield f"{name}/faults", float((~Fault.usable(rollout.fault)).mean())
        if iterations:
            many = np.concatenate([count.ravel() for count in iterations])
            yield f"{name}/iterations_mean", float(many.mean())
            yield f"{name}/iterations_p95", float(np.quantile(many, 0.95))
            yield f"{name}/iterations_max", float(many.max())
        as_is = rates.get(f"{name.partition('/')[0]}/as_is")
        if as_is:
            yield f"{name}/over_as_is", rates[name] / as_is
            yield "", max(rates[each] / rates[f"{each.partition('/')[0]}/as_is"] for each in rates)
