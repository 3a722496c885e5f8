"""One control period of a scene as one GPU kernel: a warp of 32 threads a scene, and each scene ends by itself.

XLA makes hundreds of kernels of a time step, between which every number goes through memory; its loops wait for the
slowest scene of a batch and multiply padded contacts and dense rows. The kernel (`tick_kernel.py`, made of C++ by
NVIDIA Warp) keeps a scene in shared memory for all time steps of a period: where bodies stand (`tick_motion.h`), which
geoms are near and where they touch, by the rules of `colliders` (`tick_contacts.h`, `narrow_*.h`), the cost of `cone`,
minimized in blocks of 6 x 6 (`blocks_*.h`), motors, and MuJoCo's integrator `implicitfast`. It knows what our MJCF says
and nothing else: a hand with two fingers, and free objects of three convex parts. Of more than four corners of a
contact with a box it may choose other four than `colliders`, because the box's corners are counted from another one.

It is an option of the engine `mjx` (`PhysicsConfig.solver`); on a CPU the same source runs with one thread.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Float

from dipn_jax.errors import UserError
from dipn_jax.physics.recording import State
from dipn_jax.world import shapes
from dipn_jax.world.model import GRIPPER_DOF

CAPACITIES = ((8, 80), (15, 112))
"""Blocks of a scene (the hand, and each object) and contacts that there are kernels for: 7 objects, and the most whose
shared memory is static."""
PLATFORMS = ("cpu", "gpu")
"""Kinds of devices of JAX that Warp has kernels for."""
FIELDS = ("vertex", "face_normal", "radius", "center", "body_mass", "inertia", "friction")
"""What a scene is, in the order of the kernel's first arguments."""


def capacity(slots: int, contacts: int) -> tuple[int, int]:
    """Return the blocks and the contacts of the smallest kernel for a scene.

    Args:
      slots: object slots.
      contacts: contacts that a scene can have; -1 means all.

    Raises:
      UserError: no kernel has room for them.
    """
    for blocks, most in CAPACITIES:
        if slots < blocks and 0 <= contacts <= most:
            return blocks, most
    blocks, most = CAPACITIES[-1]
    raise UserError(
        f"solver warp: {slots} object slots and {'all' if contacts < 0 else contacts} contacts a scene; "
        f"want at most {blocks - 1} and {most} (solver xla has no limit)"
    )


def check(platform: str) -> None:
    """Check that the kernel can run on a device of JAX of this kind.

    Raises:
      UserError: Warp has no such devices, finds none here, or is not installed.
    """
    if platform not in PLATFORMS:
        raise UserError(f"solver warp: JAX computes on {platform}; want {' or '.join(PLATFORMS)}, or solver xla")
    load()
    import warp

    if platform == "gpu" and not warp.is_cuda_available():
        raise UserError("solver warp: Warp finds no CUDA device here; want a newer driver, or solver xla")


def load() -> Any:
    """Return the module of the kernel.

    Raises:
      UserError: Warp is not installed, or finds no place for compiled kernels.
    """
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR  # else it writes to stdout
        warp.init()
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise UserError(
            f"solver warp: {error}; want its packages (pip install 'dipn-jax[warp]') and a writable cache folder, "
            "or solver xla"
        ) from error
    from dipn_jax.physics import tick_kernel

    return tick_kernel


def scene_fields(leaves: dict[str, Any]) -> dict[str, Float[jax.Array, " _"]]:
    """Return what the kernel takes of a scene, flat, from those leaves of an MJX model that depend on the scene."""
    hulls, parts = leaves["_impl.mesh_convex"][0], shapes.CONVEX_PARTS
    slots = len(leaves["pair_friction"]) // parts
    found = {
        "vertex": hulls.vert,
        "face_normal": hulls.face_normal,
        "radius": leaves["geom_rbound"],
        "center": leaves["geom_pos"],
        "body_mass": leaves["body_mass"][-slots:],
        "inertia": leaves["body_inertia"][-slots:],
        "friction": leaves["pair_friction"][::parts, 0],
    }
    return {name: leaf.astype(jnp.float32).reshape(-1) for name, leaf in found.items()}


class Tick:
    """The traced control period for one number of object slots."""

    def __init__(self, spec: mujoco.MjModel, *, slots: int, contacts: int, substeps: int) -> None:
        """Take the numbers of a model of ours.

        Args:
          spec: the model; its objects are placeholders.
          slots: object slots.
          contacts: contacts that a scene can have.
          substeps: time steps of a control period.

        Raises:
          UserError: more slots or contacts than a kernel has room for, a cone that is not elliptic, or no Warp.
        """
        if spec.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            raise UserError("solver warp: the cone is pyramidal; want elliptic, or solver xla")
        rooms, native = capacity(slots, contacts), load()
        self.numbers = native.numbers(spec)  # of the model
        counts = slots + 1, contacts, substeps, int(spec.opt.iterations), int(spec.opt.ls_iterations)
        self._call = _call(native.kernel(*rooms, self.numbers), *counts)

    def advance(
        self,
        scene: dict[str, jax.Array],
        state: State,
        control: Float[jax.Array, " 6"],
        push: Float[jax.Array, " V"],
    ) -> State:
        """Return the state of one scene after a control period; under `vmap`, of many.

        Args:
          scene: as by `scene_fields`.
          state: before it.
          control: set points of the motors.
          push: generalized forces from outside.

        Raises:
          UserError: the kernel cannot be compiled for JAX's device.
        """
        leaves = *(scene[name] for name in FIELDS), control, push, state.qpos, state.qvel, state.warmstart
        qpos, qvel, warmstart, full, depth = self._call(*(leaf.astype(jnp.float32) for leaf in leaves))
        return State(qpos, qvel, warmstart, state.full | (full[0] > 0), depth[0])


@functools.cache
def _call(kernel: Any, blocks: int, contacts: int, substeps: int, iterations: int, tries: int) -> Callable[..., Any]:
    """Return the kernel as a traced function of flat arrays."""
    from warp import jax_kernel

    lanes, counts = load().LANES, (blocks, contacts, substeps, iterations, tries)
    size = {"qpos_out": GRIPPER_DOF + 7 * (blocks - 1), "qvel_out": 6 * blocks, "warmstart_out": 6 * blocks}
    # the name of the call in a program is made of this, and its number is 0 where it is traced once, by the first
    # engine with these blocks: the same in every process, so that XLA finds what it compiled in another
    kernel.func.__qualname__ = "tick_" + "_".join(map(str, counts))
    call = jax_kernel(
        kernel,
        num_outputs=5,
        launch_dims=(1, lanes),
        output_dims=size | {"full_out": 1, "depth_out": 1},
        block_dim=lanes,
    )

    def traced(*leaves: jax.Array) -> Any:
        try:
            return call(*leaves, *counts)  # Warp compiles and loads the kernel here
        except Exception as error:
            if type(error) is not Exception and not isinstance(error, (RuntimeError, OSError)):
                raise
            raise UserError(f"solver warp: {error}; want a device that Warp compiles for, or solver xla") from error

    return jax.jit(traced)
