"""What other settings of MJX would cost, and how far their episodes are from MuJoCo C's."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from dipn_jax.datagen import world

from benchmarks.datagen_mjx import engine
from benchmarks.harness import Setting, alternate
from dipn_jax.engine import Engine
from dipn_jax.physics import make_engine, mjx
from dipn_jax.structs import Fault
from dipn_jax.world import primitives

VARIANTS: dict[str, dict[str, Any]] = {
    "as_is": {},
    "timestep_2ms": {"timestep": 0.002},
    "timestep_5ms": {"timestep": 0.005},
    "iterations_10": {"iterations": 10, "ls_iterations": 20},
    "pyramidal": {"cone": "pyramidal"},
    "impratio_1": {"impratio": 1.0},
    "half_the_pairs": {"geom_pairs": (16, 2)},
    "all_pairs": {"geom_pairs": None},
    "half_the_contacts": {"contact_points": (40, 4)},
    "twice_the_contacts": {"contact_points": (160, 16)},
}
"""Settings that differ from `mjx.DEFAULTS`: solver, contact cap, broad phase."""
SHOWN = {"p50_mm": "5cm/p50_mm", "p90_mm": "5cm/p90_mm", "grasps_equal": "grasp"}
"""Figures of `world.agreement` that are shown; one that is not finite is left out, and `faults` then says why."""


def settings(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds over those of the engine's own settings, and the agreement with MuJoCo C, for each variant.

    The scenes are those of `dipn-datagen check-world`: 1 to 7 objects, a push and a grasp in each.
    """
    native = make_engine("native")
    made = world.trial(jax.random.split(jax.random.key(setting.seed), 3)[1], native, setting.pick(16, 32))
    poses, held = world.pushes(native, made)[1], world.held_by(native, made)
    as_is = engine()
    for name, changes in VARIANTS.items():
        other = mjx.MjxEngine(dataclasses.replace(mjx.DEFAULTS, **changes)) if changes else as_is
        at = f"datagen_mjx.settings/{name}"
        found = world.agreement(name, other, made, poses, held)  # compiles
        if changes:
            ours, theirs = alternate(lambda: _push(as_is, made), lambda e=other: _push(e, made), repeats=1)  # type: ignore[misc]
            yield f"{at}/time", theirs / ours
        figures = {key: found[f"agreement/{name}/{of}"] for key, of in SHOWN.items()}
        figures["faults"] = float((~Fault.usable(_push(other, made))).mean())
        yield from ((f"{at}/{key}", value) for key, value in figures.items() if np.isfinite(value))


def _push(engine: Engine, made: world.Trial) -> Any:
    """Return faults `[B]` of the trial's pushes."""
    return primitives.push(engine, made.items.scene, made.items.poses, made.pushes).fault
