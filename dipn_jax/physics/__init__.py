"""One interface, four engines: `native` (MuJoCo C on CPU threads), `mjx` (XLA: GPU, TPU, CPU), `mjx_warp`, `warp`.

In `mjx_warp` the kernel of `tick` computes the time steps of `mjx`; `warp` is MuJoCo Warp, for NVIDIA GPUs.

All read the same MJCF (`dipn_jax.world.model`), take the same arguments and return the same result, so which
one runs is a configuration value.
"""

from __future__ import annotations

import dataclasses
from types import ModuleType

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dipn_jax.engine import Engine, PhysicsConfig
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.structs import Array
from dipn_jax.system.machine import cores

CONTROL_PERIOD = 0.01
"""Seconds between set points, and between looks for faults."""
MOST_SUBSTEPS = 100
"""Time steps that a control period may have."""
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
    """Return the forces of a fence on objects; it has no surface, so any number of objects costs no contact.

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


def substeps(config: PhysicsConfig) -> int:
    """Return the number of time steps in a control period.

    Raises:
      UserError: that is not a whole number.
    """
    count = round(CONTROL_PERIOD / config.timestep) if config.timestep >= CONTROL_PERIOD / MOST_SUBSTEPS else 0
    if count < 1 or abs(count * config.timestep - CONTROL_PERIOD) > 1e-9:
        raise UserError(
            f"--timestep {config.timestep}: want {CONTROL_PERIOD} over a whole number from 1 to {MOST_SUBSTEPS}"
        )
    return count


def resolve(name: EngineName) -> EngineName:
    """Return the name of an engine: `auto` is `native`, or `mjx` on an accelerator whose host has few cores.

    Few are less than ENOUGH_CORES. It is never `warp`, though that is faster on a GPU: it is an extra, and its scenes
    share their room for contacts. `mjx_warp` needs the same extra and has not been measured on a GPU.
    """
    if name == "auto":
        return "native" if jax.default_backend() == "cpu" or cores() >= ENOUGH_CORES else "mjx"
    return name


def make_engine(
    name: EngineName, *, timestep: float | None = None, sleep: float | None = None, threads: int | None = None
) -> Engine:
    """Make the engine called `name`, with its own solver settings unless others are given.

    Example:
      engine = dipn_jax.make_engine("native")
      tables = dipn_jax.settled_scenes(jax.random.key(0), engine, dipn_jax.SceneConfig(), 2)

    Making `mjx` patches MuJoCo MJX in the whole process (`physics.patches`); models of other code that uses MJX in the
    process are passed on to MJX's own functions. The other engines patch nothing.

    Args:
      name: engine, or `auto`.
      timestep: seconds of every physics step, instead of the engine's own.
      sleep: `PhysicsConfig.sleep`, instead of the engine's own; `native` and `warp` can.
      threads: on which `native` simulates, one a core if not given; no result depends on it.

    Raises:
      UserError: no such engine, it cannot run here, fewer threads than one, or a time step that does not divide the
        control period.
    """
    name = resolve(name)
    if threads is not None and threads < 1:
        raise UserError(f"--threads {threads}: want at least 1, or none given for one a core")
    if name == "native":
        from dipn_jax.physics import native

        return native.NativeEngine(_configured(native.DEFAULTS, timestep, sleep), threads=threads)
    if name == "mjx":
        from dipn_jax.physics import mjx

        return mjx.MjxEngine(_configured(mjx.DEFAULTS, timestep, sleep))
    if name == "mjx_warp":
        from dipn_jax.physics import mjx

        return mjx.MjxEngine(_configured(dataclasses.replace(mjx.DEFAULTS, solver="warp"), timestep, sleep))
    if name == "warp":
        from dipn_jax.physics import warp

        return warp.WarpEngine(_configured(warp.DEFAULTS, timestep, sleep))
    raise UserError(f"engine {name!r}: want auto, native, mjx, mjx_warp or warp")


def _configured(config: PhysicsConfig, timestep: float | None, sleep: float | None) -> PhysicsConfig:
    """Return `config` with the time step and the sleep that are given."""
    return dataclasses.replace(
        config,
        timestep=config.timestep if timestep is None else timestep,
        falling_timestep=config.falling_timestep if timestep is None else 0.0,
        sleep=config.sleep if sleep is None else sleep,
    )
