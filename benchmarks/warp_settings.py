"""What other settings of MuJoCo Warp would cost, and how far their pushes are from MuJoCo C's."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from dipn_jax.datagen import world

from benchmarks.harness import Setting, Skipped, alternate
from dipn_jax.engine import Engine
from dipn_jax.physics import make_engine
from dipn_jax.physics.warp import DEFAULTS, WarpEngine
from dipn_jax.structs import Fault
from dipn_jax.world import primitives

VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "as_is": ({}, {}),
    "tolerance_1e-5": ({"tolerance": 1e-5}, {}),
    "tolerance_1e-4": ({"tolerance": 1e-4}, {}),
    "iterations_15": ({"iterations": 15}, {}),
    "iterations_10": ({"iterations": 10}, {}),
    "iterations_6": ({"iterations": 6}, {}),
    "sleep": ({"sleep": 1e-3}, {}),
    "asleep": ({"sleep": 1e-3}, {"awake": 4}),
    "large_room": ({}, {"room": (24, 12, 72)}),
    "dense": ({}, {"jacobian": "dense"}),
}
"""Settings of the solver and of the engine that differ from its own."""
PUSHED = 0.05
"""Metres of a push after which poses are compared."""


def settings(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure `engines.warp_settings/VARIANT/...` on the scenes of `dipn-datagen check-world`, of 1 to 7 objects.

    Seconds of a rollout over those with the engine's own settings, millimetres from MuJoCo C of the objects that it
    moves, the iterations of the solver over all scenes and steps, and the share of scenes with a fault.
    """
    if importlib.util.find_spec("warp") is None:
        raise Skipped("MuJoCo Warp is not installed; run pip install 'dipn-jax[warp]'")
    native = make_engine("native")
    made = world.trial(jax.random.split(jax.random.key(setting.seed), 3)[1], native, setting.pick(16, 64))
    wanted = _push(native, made).poses[:, -1]
    moved = np.linalg.norm((wanted - made.items.poses)[..., :3], axis=-1) > world.MOVED_DISTANCE
    moved &= np.asarray(made.items.scene.shape) >= 0
    own = WarpEngine()
    for name, (solver, options) in VARIANTS.items():
        engine, at = WarpEngine(dataclasses.replace(DEFAULTS, **solver), **options), f"engines.warp_settings/{name}"
        found = _push(engine, made)  # compiles
        if name != "as_is":
            ours, theirs = alternate(lambda: _push(own, made), lambda e=engine: _push(e, made), repeats=1)  # type: ignore[misc]
            yield f"{at}/time", theirs / ours
        apart = 1000 * np.linalg.norm((found.poses[:, -1] - wanted)[..., :3], axis=-1)[moved]
        yield from ((f"{at}/p{q}_mm", float(np.quantile(apart, q / 100))) for q in (50, 90))
        yield from ((f"{at}/iterations_{of}", value) for of, value in engine.iterations._asdict().items())
        yield f"{at}/faults", float((~Fault.usable(found.fault)).mean())


def _push(engine: Engine, made: world.Trial) -> Any:
    """Return the rollouts of the trial's pushes until PUSHED."""
    end = primitives.push_samples()[round(100 * PUSHED)]
    return engine.simulate(made.items.scene, made.items.poses, primitives.push_trajectory(made.pushes), np.array([end]))
