"""The stage of `on_gpu` about other settings of the accelerators' engines: what each gives, and its solver's work."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

import numpy as np

from benchmarks.gpu_engines import heap_rate, heaps_of, make_ready
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
    "warp/dense": {"jacobian": "dense"},
    "warp/sparse": {"jacobian": "sparse"},
    "warp/iterations_15": {CONFIG: {"iterations": 15}},
    "warp/tolerance_1e-5": {CONFIG: {"tolerance": 1e-5}},
    "warp/tolerance_1e-5_iterations_15": {CONFIG: {"tolerance": 1e-5, "iterations": 15}},
    "warp/large_room": {"room": (24, 12, 72)},
    "warp/dense_large_room": {"jacobian": "dense", "room": (24, 12, 72)},
    "warp/line_search_15": {CONFIG: {"ls_iterations": 15}},
    "warp/asleep": {CONFIG: {"sleep": 1e-3}},
    "warp/timestep_2.5ms": {CONFIG: {"timestep": 0.0025}},
}
"""Variants of MuJoCo Warp: arguments of its engine, and changes of its configuration."""
MJX: dict[str, dict[str, Any]] = {
    "mjx/as_is": {},
    "mjx/warp_kernel": {CONFIG: {"solver": "warp"}},
    "mjx/iterations_15": {CONFIG: {"iterations": 15}},
    "mjx/half_the_contacts": {CONFIG: {"contact_points": (40, 4)}},
}
"""Variants of MJX; each compiles a program of its own."""
ALL = WARP | MJX
"""All variants by name."""


def variant(name: str, *, batch: int, timestep: float | None = None) -> Engine:
    """Return an engine with the settings of `ALL[name]`, for `batch` scenes at once; and a time step, if one is given.

    Raises:
      NotMeasured: the engine is not installed, or knows no such setting.
    """
    if name.startswith("warp") and not installed("warp"):
        raise NotMeasured("not available: MuJoCo Warp is not installed; install the extra `warp`")
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


def iterations(engine: Engine) -> dict[str, float]:
    """Return the mean, the 95th percentile and the maximum of the solver's iterations in an engine's last simulation.

    Raises:
      NotMeasured: the engine does not count them.
    """
    found = getattr(engine, "iterations", None)
    if not isinstance(found, tuple):
        raise NotMeasured(f"iterations not measured: {engine.name} does not count those of its solver")
    names = ("iterations_mean", "iterations_p95", "iterations_max")
    return dict(zip(names, map(float, found), strict=True))


def variants(size: Size) -> Found:
    """Measure each variant on falling heaps: scene seconds a second, scenes with a fault, iterations of its solver."""
    batch = size.batches[0]
    scene, poses = heaps_of(size, batch)
    still, end = primitives.parked_trajectory(batch, size.heap_seconds), np.array([size.heap_seconds])
    rates: dict[str, float] = {}
    for name in [*list(MJX)[: size.mjx_variants], *list(WARP)[: size.variants]]:
        try:
            engine = variant(name, batch=batch, timestep=size.timestep)
            make_ready(engine, scene, poses)
            rates[name] = heap_rate(engine, scene, poses, size)
            yield f"{name}/scene_seconds", rates[name]
            rollout = engine.simulate(scene, poses, still, end)
            yield f"{name}/faults", float((~Fault.usable(rollout.fault)).mean())
            if plain := rates.get(f"{engine.name}/as_is"):
                yield f"{name}/over_as_is", rates[name] / plain
            for key, value in iterations(engine).items():
                yield f"{name}/{key}", value
        except NotMeasured as reason:
            yield name, str(reason)
        except Exception as error:  # as a setting that MuJoCo Warp does not have for these models
            yield name, f"failed: {brief(error)}"
    as_is = {name: rates.get(f"{name.partition('/')[0]}/as_is") for name in rates}
    ratios = [rates[name] / rate for name, rate in as_is.items() if rate]
    if ratios:
        yield "", max(ratios)
