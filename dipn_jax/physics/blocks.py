"""The solver of `cone` as one GPU kernel: a warp of 32 threads a scene, and each scene ends when it has converged.

XLA's loops wait for the slowest scene of a batch, multiply padded contacts, and keep a dense Jacobian of which a
contact touches 12 columns. The kernel (`blocks_kernel.py`, made of C++ by NVIDIA Warp) is given contact frames, lever
arms and the two bodies instead, leaves out contacts that do not touch, and factors a Hessian of blocks of 6 x 6: the
hand is one (x, y, z, yaw, two fingers), each object another. The cost that it minimizes is that of `cone`.

It is an option of the engine `mjx` (`PhysicsConfig.solver`), together with the collision of `narrow`. On a CPU the same
source runs with one thread.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float, Int
from mujoco.mjx._src import constraint, support

from dipn_jax.errors import UserError
from dipn_jax.physics import cone
from dipn_jax.structs import Array, Pytree

BLOCK_DOFS = 6
"""Degrees of freedom of a block."""
CAPACITIES = ((8, 80), (15, 112))
"""Blocks and contacts of a scene that there are kernels for: 7 objects, and the most whose shared memory is static."""
PLATFORMS = ("cpu", "gpu")
"""Kinds of devices of JAX that Warp has kernels for."""
ARGUMENTS = (
    *("mass", "force", "free", "velocity", "center", "axes", "row", "row_goal", "row_weight"),
    *("position", "frame", "side", "scale", "stiffness", "damping", "bias"),
)
"""Fields of a problem in the order of the kernel's first arguments; then comes the acceleration to begin from."""


@flax.struct.dataclass
class Problem(Pytree):
    """The problem of `cone._Problem` in blocks: bodies of a tree are one block, and a contact moves two at most.

    The first three degrees of freedom of a block move its bodies along x, y and z.
    """

    mass: Float[Array, "*b B 6 6"]
    free: Float[Array, "*b B*6"]  # acceleration without constraints
    force: Float[Array, "*b B*6"]  # mass @ free
    velocity: Float[Array, "*b B*6"]
    center: Float[Array, "*b B 3"]  # metres, world: what lever arms begin at
    axes: Float[Array, "*b B 3 6"]  # how the other three turn and shift a body at the centre, world
    row: Float[Array, "*b R 6"]  # equalities, then limits, of the first block
    row_goal: Float[Array, "*b R"]
    row_weight: Float[Array, "*b R"]
    position: Float[Array, "*b C 3"]  # metres, world: of contacts
    frame: Float[Array, "*b C 3 3"]  # rows: normal from the first body to the second, tangents
    side: Int[Array, "*b C 2"]  # the two bodies: 8 block + a bit for each of the other three that move it; -1: table
    scale: Float[Array, "*b C 3"]  # of the three rows of a contact; the first is the slope of the scaled cone
    stiffness: Float[Array, "*b C"]  # 0: no contact
    damping: Float[Array, "*b C"]  # 1/s: the goal is -damping * velocity
    bias: Float[Array, "*b C"]  # m/s^2: minus this along the normal
    equalities: int = flax.struct.field(pytree_node=False)


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
        f"solver warp: {slots} object slots and {contacts} contacts a scene; "
        f"want at most {blocks - 1} and {most} (solver xla has no limit)"
    )


def check(platform: str) -> None:
    """Check that the kernel can run on a device of JAX of this kind.

    Raises:
      UserError: Warp has no such devices, or it is not installed.
    """
    if platform not in PLATFORMS:
        raise UserError(f"solver warp: JAX computes on {platform}; want {' or '.join(PLATFORMS)}, or solver xla")
    load()


def load() -> Any:
    """Return the module of the kernel.

    Raises:
      UserError: Warp is not installed, or finds no place for compiled kernels.
    """
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR  # else it writes to stdout
        warp.init()
        from dipn_jax.physics import blocks_kernel
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise UserError(
            f"solver warp: {error}; want its packages (pip install 'dipn-jax[warp]') and a writable cache folder, "
            "or solver xla"
        ) from error
    return blocks_kernel


def minimize(p: Problem, start: Float[Array, " V"], iterations: int, line: int) -> tuple[jax.Array, jax.Array]:
    """Return the acceleration `[V]` with the least cost, and the number of Newton's steps taken `[1]`.

    Args:
      p: the problem of one scene; under `vmap`, of many.
      start: an acceleration to begin from where it costs less than `p.free`.
      iterations: most of Newton's steps.
      line: most tries of a line search.
    """
    call = _call(len(p.mass), len(p.position), len(p.row), p.equalities, iterations, line)
    acceleration, steps = call(*(jnp.asarray(getattr(p, name)).reshape(-1) for name in ARGUMENTS), start)
    return acceleration, steps


@functools.cache
def _call(blocks: int, contacts: int, rows: int, equalities: int, iterations: int, line: int) -> Callable[..., Any]:
    """Return the kernel as a traced function of flat arrays, for those numbers of each and those limits."""
    from warp import jax_kernel

    native = load()
    kernel = native.kernel(*capacity(blocks - 1, contacts))
    numbers = blocks, contacts, rows, equalities, iterations, line
    # the name of the call in a program is made of this, and its number is 0 where it is traced once: the same in every
    # process, so that XLA finds what it compiled in another
    kernel.func.__qualname__ = "blocks_" + "_".join(map(str, numbers))
    call = jax_kernel(
        kernel,
        num_outputs=2,
        launch_dims=(1, native.LANES),
        output_dims={"acceleration": BLOCK_DOFS * blocks, "steps": 1},
        block_dim=native.LANES,
    )
    return jax.jit(lambda *leaves: call(*leaves, *numbers))


def _sides(m: Any) -> np.ndarray:
    """Return for each geom which joints move it, coded as in `Problem.side`: `[ngeom]`."""
    dof_body, parent = np.asarray(m.dof_bodyid), np.asarray(m.body_parentid)
    code = np.full(len(parent), -1)
    for body in range(1, len(parent)):
        line = [body]
        while line[-1]:
            line.append(parent[line[-1]])
        dofs = np.flatnonzero(np.isin(dof_body, line))
        bits = [1 << place for place in dofs % BLOCK_DOFS - BLOCK_DOFS // 2 if place >= 0]
        code[body] = 8 * (dofs[0] // BLOCK_DOFS) + sum(bits) if len(dofs) else -1
    return code[np.asarray(m.geom_bodyid)].astype(np.int32)


def _rows(m: Any, d: Any) -> tuple[jax.Array, jax.Array, jax.Array, int]:
    """Return rows `[R, 6]`, goals `[R]` and weights `[R]` of equalities and limits, and the number of equalities."""
    found = [constraint._efc_equality_joint(m, d), constraint._efc_limit_slide_hinge(m, d)]
    efc = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    k, b, imp = jax.vmap(lambda *args: constraint._kbi(m, *args))(efc.solref, efc.solimp, efc.pos_imp)
    resistance = jnp.maximum(efc.invweight * (1 - imp) / imp, mujoco.mjMINVAL)
    goal = -b * (efc.J @ d.qvel) - k * imp * efc.pos_aref
    return efc.J[:, :BLOCK_DOFS], goal, 1 / resistance, len(found[0].pos_aref)


def problem(m: Any, d: Any) -> Problem:
    """Return the problem of one state of a model of ours.

    MJX's dense rows of contacts (`efc_J`) are not looked at, so XLA leaves them out.

    Args:
      m: MJX model as for `cone.solve`, with the gripper's six degrees of freedom and six an object.
      d: its data, up to `forward.fwd_acceleration`.
    """
    contact, blocks = d._impl.contact, m.nv // BLOCK_DOFS
    row, goal, weight, equalities = _rows(m, d)
    distance = contact.dist - contact.includemargin
    k, b, imp = jax.vmap(lambda *args: constraint._kbi(m, *args))(contact.solref, contact.solimp, distance)
    light = m.body_invweight0[jnp.asarray(m.geom_bodyid)[contact.geom], 0].sum(-1)  # of both bodies
    resistance = jnp.maximum(light * (1 - imp) / imp, mujoco.mjMINVAL)
    mu = contact.friction[:, 0] / jnp.sqrt(m.opt.impratio)
    mass = support.full_m(m, d).reshape(blocks, BLOCK_DOFS, blocks, BLOCK_DOFS)
    each = np.arange(blocks)
    first_body = np.asarray(m.dof_bodyid)[::BLOCK_DOFS]
    return Problem(
        mass=mass[each, :, each],
        free=d.qacc_smooth,
        force=d.qfrc_smooth,
        velocity=d.qvel,
        center=d.subtree_com[np.asarray(m.body_rootid)[first_body]],
        axes=d.cdof.reshape(blocks, BLOCK_DOFS, BLOCK_DOFS)[:, BLOCK_DOFS // 2 :],
        row=row,
        row_goal=goal,
        row_weight=weight,
        position=contact.pos,
        frame=contact.frame,
        side=jnp.asarray(_sides(m))[contact.geom],
        scale=jnp.concatenate([mu[:, None], contact.friction[:, :2]], -1),
        stiffness=jnp.where(distance < 0, 1 / (resistance * jnp.maximum(mu**2, cone.TINY)), 0.0),
        damping=b,
        bias=k * imp * distance,
        equalities=equalities,
    )


def solve(m: Any, d: Any) -> Any:
    """Compute the constraint forces and accelerations of one state.

    Args:
      m: MJX model, as for `problem`.
      d: its data, up to `forward.fwd_acceleration`.

    Returns:
      `d` with `qacc` and `qfrc_constraint`, as `cone.solve` does; forces of single constraints are not computed.
    """
    p = problem(m, d)
    a, _ = minimize(p, d.qacc_warmstart, int(m.opt.iterations), int(m.opt.ls_iterations))
    force = jnp.einsum("bij,bj->bi", p.mass, a.reshape(-1, BLOCK_DOFS)).reshape(-1) - p.force
    return d.tree_replace({"qacc": a, "qfrc_constraint": force})
