"""One interface, three engines: `native` (MuJoCo C on CPU threads), `mjx` (XLA: GPU, TPU, CPU) and `warp` (NVIDIA).

All read the same MJCF (`dipn_jax.world.model`), take the same arguments and return the same result, so which
one runs is a configuration value.
"""

from __future__ import annotations

import dataclasses
import os
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dipn_jax.engine import Engine, EngineName, PhysicsConfig
from dipn_jax.errors import UserError
from dipn_jax.structs import Array

CONTROL_PERIOD = 0.01
"""Seconds between set points; faults are looked for as often."""
MOST_SUBSTEPS = 100
"""Time steps in a control period at most."""
FENCE = 0.17
"""Metres from the workspace's centre along x or y beyond which a fence pushes centres of mass back."""
FENCE_RATE = 30.0
"""rad/s of the fence's critically damped spring (per mass): 11 mm beyond it, the push is an object's weight."""

ENOUGH_CORES = 8
"""Cores with which `native` is as fast as `mjx` on a large GPU (docs/benchmarks.md: an H200 does the work of 8.4)."""


def fence_force(
    mass: Float[Array, "*b N"],
    position: Float[Array, "*b N 2"],
    velocity: Float[Array, "*b N 2"],
    *,
    xp: ModuleType = jnp,
) -> Float[Array, "*b N 2"]:
    """What a fence does to objects: it has no surface, so any number of them costs no contact.

    Args:
      mass: kg.
      position: metres, workspace: centres of mass.
      velocity: m/s.
      xp: numpy or jax.numpy.

    Returns:
      Forces in newtons: zero within FENCE, a damped spring beyond.
    """
    beyond = position - xp.clip(position, -FENCE, FENCE)
    pull = -(FENCE_RATE**2) * beyond - 2 * FENCE_RATE * velocity
    return mass[..., None] * xp.where(beyond == 0, 0.0, pull)


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def substeps(config: PhysicsConfig) -> int:
    """Time steps in a control period.

    Raises:
      UserError: that is not a whole number.
    """
    count = round(CONTROL_PERIOD / config.timestep) if config.timestep >= CONTROL_PERIOD / MOST_SUBSTEPS else 0
    if count < 1 or abs(count * config.timestep - CONTROL_PERIOD) > 1e-9:
        raise UserError(
            f"physics timestep {config.timestep}: want {CONTROL_PERIOD} over a whole number from 1 to {MOST_SUBSTEPS}"
        )
    return count


def resolve(name: EngineName) -> EngineName:
    """`auto` is `native`, or `mjx` on an accelerator whose host has few cores (ENOUGH_CORES).

    Never `warp`, though it is faster there: it is an extra, and its scenes share their room for contacts.
    """
    if name == "auto":
        return "native" if jax.default_backend() == "cpu" or cores() >= ENOUGH_CORES else "mjx"
    return name


def make_engine(name: EngineName, *, timestep: float | None = None, sleep: float | None = None) -> Engine:
    """The engine called `name`, with its own solver settings.

    Args:
      name: engine, or `auto`.
      timestep: seconds of a physics step, instead of the engine's own.
      sleep: `PhysicsConfig.sleep`, instead of the engine's own; only `native` can.

    Raises:
      UserError: no such engine, it cannot run here, or a time step that does not divide the control period.
    """
    given = {"timestep": timestep, "sleep": sleep}
    changes: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    name = resolve(name)
    if name == "native":
        from dipn_jax.physics import native

        return native.NativeEngine(dataclasses.replace(native.DEFAULTS, **changes))
    if name == "mjx":
        from dipn_jax.physics import mjx

        return mjx.MjxEngine(dataclasses.replace(mjx.DEFAULTS, **changes))
    if name == "warp":
        from dipn_jax.physics import warp

        return warp.WarpEngine(dataclasses.replace(warp.DEFAULTS, **changes))
    raise UserError(f"engine {name!r}: want auto, native, mjx or warp")
