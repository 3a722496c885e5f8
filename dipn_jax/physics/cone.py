"""Contact forces with elliptic friction cones that stay right in float32, unlike those of MJX's solver.

MJX's line search computes the squared length of a contact's tangential residual as `uu + a (2 uv + a vv)`. Where
a Newton step ends sliding that is zero, in float32 often a little below it; the root is NaN, the cost of the whole
step is NaN, and comparisons with NaN choose the wrong end of the bracket or none: the solver stops with forces
that do not fit, and objects fly off. Here residuals are moved along the step before any length is taken.

What is left of the gradient must not become motion: `forward.implicit` divides the sum of forces by the mass alone,
so a residue of 1e-3 N m on a light object is a kick of 0.1 rad/s. The force returned is the acceleration's.

The problem is MuJoCo's: the acceleration that minimizes a convex cost ("Computation: soft contact model" in its
documentation). Scaled by friction, a contact's residual `u` is to lie in the cone `u_0 >= mu |u_t|` and pays
`stiffness / 2` times the squared distance to it, so cost, gradient and Hessian follow from one projection.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from mujoco.mjx._src import support
from mujoco.mjx._src.types import ConeType, SolverType

from dipn_jax.structs import Pytree

NEWTON_TOLERANCE = 1e-6
"""Share of the cost: Newton ends when it can still lower the cost by less (float32 resolves 1e-7)."""
FLAT_SLOPE = 0.1
"""Share of the slope at its beginning below which the line search ends."""
NARROW_BRACKET = 1e-2
"""Share of the step below which the line search ends too, when its bracket is that narrow: rounding hides the slope."""
FIRST_STEPS = np.float32(4.0) ** np.arange(-6, 2, dtype=np.float32)
"""Multiples of a Newton step that are tried first, all at once: many cost an accelerator no more than one."""
STRETCH_LIMIT = 4.0 ** len(FIRST_STEPS)
"""Factor by which a step grows at most from one round of tries to the next while the minimum is further on."""
TINY = 1e-12
"""Least divisor: lengths and squares are raised to it before something is divided by them."""


@flax.struct.dataclass
class _Problem(Pytree):
    """The problem: minimize `(a - free)' mass (a - free) / 2` plus the costs of the rows and cones."""

    mass: Float[jax.Array, "*b V V"]
    free: Float[jax.Array, "*b V"]  # acceleration without constraints
    force: Float[jax.Array, "*b V"]  # mass @ free
    rows: Float[jax.Array, "*b R V"]  # equalities and limits
    goal: Float[jax.Array, "*b R"]
    weight: Float[jax.Array, "*b R"]
    always: Bool[jax.Array, "*b R"]  # an equality, else one-sided
    cones: Float[jax.Array, "*b C K V"]  # normal and tangents of contacts, scaled
    cone_goal: Float[jax.Array, "*b C K"]
    stiffness: Float[jax.Array, "*b C"]
    mu: Float[jax.Array, "*b C"]  # slope of the scaled cone


@flax.struct.dataclass
class _Reach(Pytree):
    """Where residuals `u [C, K]` lie relative to their cones."""

    away: Float[jax.Array, "*b C K"]  # from the nearest point of the cone to u
    below: Bool[jax.Array, "*b C"]  # the nearest point is the tip
    beside: Float[jax.Array, "*b C"]  # share of a residual on the cone's side, 1 / (1 + mu^2); 0 elsewhere
    inward: Float[jax.Array, "*b C K"]  # normal of the side, first component 1
    tangent: Float[jax.Array, "*b C K"]  # unit vector of sliding, first component 0
    bend: Float[jax.Array, "*b C"]  # curvature across it, not negative


def _reach(u: jax.Array, mu: jax.Array) -> _Reach:
    """Project `u [C, K]` on the cones `u_0 >= mu |u_t|`."""
    slide = u.at[:, 0].set(0.0)
    length = jnp.linalg.norm(slide, axis=-1)
    tangent = slide / jnp.maximum(length, TINY)[:, None]
    below = (mu * u[:, 0] + length <= 0) & (u[:, 0] < 0)
    short = jnp.minimum(u[:, 0] - mu * length, 0.0)  # of the side
    beside = jnp.where(below | (short >= 0), 0.0, 1 / (1 + mu**2))
    inward = (-mu[:, None] * tangent).at[:, 0].set(1.0)
    away = jnp.where(below[:, None], u, (beside * short)[:, None] * inward)
    return _Reach(away, below, beside, inward, tangent, -short * mu / jnp.maximum(length, TINY))


def _curvature(reach: _Reach, w: jax.Array) -> jax.Array:
    """Return the second derivative `[C]` of half the squared distance along `w [C, K]`."""
    along = (reach.tangent * w).sum(-1, keepdims=True)
    across = (w - along * reach.tangent).at[:, 0].set(0.0)
    side = (reach.inward * w).sum(-1) ** 2 + reach.bend * (across**2).sum(-1)
    return jnp.where(reach.below, (w**2).sum(-1), reach.beside * side)


def _blocks(reach: _Reach) -> jax.Array:
    """Return the Hessian `[C, K, K]` of half the squared distance: a sum of squares, so never really indefinite."""
    eye = jnp.eye(reach.away.shape[1])

    def outer(v: jax.Array) -> jax.Array:
        return v[:, :, None] * v[:, None, :]

    across = eye.at[0, 0].set(0.0) - outer(reach.tangent)
    side = outer(reach.inward) + reach.bend[:, None, None] * across
    return jnp.where(reach.below[:, None, None], eye, reach.beside[:, None, None] * side)


def _residuals(p: _Problem, a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the residuals of the rows `[R]` and of the cones `[C, K]`."""
    return p.rows @ a - p.goal, p.cones @ a - p.cone_goal


def _pushing(p: _Problem, x: jax.Array) -> jax.Array:
    """Return weights `[R]` of rows with residuals `x`; zero for those that do not push."""
    return jnp.where(p.always | (x < 0), p.weight, 0.0)


def _cost(p: _Problem, a: jax.Array) -> jax.Array:
    x, u = _residuals(p, a)
    moved = a - p.free
    contacts = p.stiffness * (_reach(u, p.mu).away ** 2).sum(-1)
    return ((p.mass @ moved) @ moved + (_pushing(p, x) * x**2).sum() + contacts.sum()) / 2


def _newton(p: _Problem, a: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return cost `[]`, gradient `[V]` and Newton step `[V]` at `a`."""
    x, u = _residuals(p, a)
    push, reach = _pushing(p, x), _reach(u, p.mu)
    away = p.stiffness[:, None] * reach.away
    lack = p.mass @ a - p.force
    gradient = lack + (push * x) @ p.rows + jnp.einsum("ck,ckv->v", away, p.cones)
    blocks = (p.stiffness[:, None, None] * _blocks(reach))[..., None]
    bent = (blocks * p.cones[:, None]).sum(2)  # of three: on a GPU as a product a fifth of a step
    flat = p.cones.reshape(-1, p.cones.shape[-1])
    hessian = p.mass + (p.rows.T * push) @ p.rows + flat.T @ bent.reshape(flat.shape)
    size = jax.lax.rsqrt(jnp.diagonal(hessian))  # masses and inertias differ by 10^5
    factor = jax.scipy.linalg.cho_factor(hessian * size[:, None] * size, lower=True)
    step = -size * jax.scipy.linalg.cho_solve(factor, size * gradient)
    cost = (lack @ (a - p.free) + (push * x**2).sum() + (away * reach.away).sum()) / 2
    return cost, gradient, step


def _slopes(p: _Problem, a: jax.Array, step: jax.Array) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """Return a function of the multiple of `step` taken: first and second derivative of the cost along it."""
    x, u = _residuals(p, a)
    dx, du = p.rows @ step, p.cones @ step
    slope_0, slope_1 = (p.mass @ a - p.force) @ step, (p.mass @ step) @ step

    def slopes(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        at, reach = x + t * dx, _reach(u + t * du, p.mu)  # first moved, then measured: nothing cancels
        push = _pushing(p, at)
        first = slope_0 + t * slope_1 + (push * at * dx).sum() + (p.stiffness * (reach.away * du).sum(-1)).sum()
        return first, slope_1 + (push * dx**2).sum() + (p.stiffness * _curvature(reach, du)).sum()

    return slopes


def _line_search(
    p: _Problem, a: jax.Array, step: jax.Array, begin: jax.Array, limit: int, idle: jax.Array
) -> jax.Array:
    """Return the multiple of `step` with the least cost: many are tried at once, then Newton and more in a bracket.

    `begin` is the slope at the beginning of the step. In a batch all scenes wait for the one that needs most rounds; a
    scene that is `idle`, because its result is not used, takes none.
    """
    slopes = jax.vmap(_slopes(p, a, step))
    parts = jnp.arange(1, len(FIRST_STEPS)) / len(FIRST_STEPS)

    def going(state: tuple[jax.Array, ...]) -> jax.Array:
        return ~state[-1] & (state[-2] < limit)

    def body(state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        low, high, tries, _, count, _ = state
        first, second = slopes(tries)  # it rises from try to try: the cost is convex
        low = jnp.maximum(low, jnp.where(first < 0, tries, 0.0).max())
        high = jnp.minimum(high, jnp.where(first < 0, jnp.inf, tries).min())
        steep = jnp.where(jnp.isfinite(first), jnp.abs(first), jnp.inf)
        best = steep.argmin()
        found = (steep[best] <= FLAT_SLOPE * jnp.abs(begin)) | (
            jnp.isfinite(high) & (high - low <= NARROW_BRACKET * high)
        )
        guess = tries[best] - first[best] / second[best]
        end = jnp.where(jnp.isfinite(high), high, STRETCH_LIMIT * low)
        start = jnp.where(low > 0, low, FIRST_STEPS[0] * high)
        inside = (guess > low) & (guess < end)
        more = start * (end / start) ** parts
        fresh = jnp.append(more, jnp.where(inside, guess, jnp.sqrt(start * end)))
        return low, high, fresh, tries[best], count + 1, found

    zero = jnp.zeros_like(begin)
    tries = jnp.asarray(FIRST_STEPS)
    state: tuple[jax.Array, ...] = (zero, zero + jnp.inf, tries, zero, jnp.zeros((), jnp.int32), idle)
    low, _, _, t, _, found = jax.lax.while_loop(going, body, state)
    return jnp.where(found, t, low)  # the cost falls all the way to `low`


def _minimize(p: _Problem, start: jax.Array, iterations: int, line: int) -> jax.Array:
    """Return the acceleration `[V]` with the least cost."""

    def going(state: tuple[jax.Array, ...]) -> jax.Array:
        return ~state[-1] & (state[-2] < iterations)

    def body(state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        a, count, done = state
        cost, gradient, step = _newton(p, a)
        slope = gradient @ step
        a = a + jnp.where(slope < 0, _line_search(p, a, step, slope, line, done), 0.0) * step
        return a, count + 1, ~(-slope / 2 > NEWTON_TOLERANCE * cost)

    state: tuple[jax.Array, ...] = (start, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    return jax.lax.while_loop(going, body, state)[0]


def _problem(m: Any, d: Any) -> tuple[_Problem, np.ndarray, jax.Array]:
    """Return the problem, the constraint rows `[C, K]` of its cones (-1: none) and their scales `[C, K]`."""
    impl, contact = d._impl, d._impl.contact
    dims, first = np.asarray(contact.dim), np.asarray(contact.efc_address)
    k = np.arange(dims.max())
    index = np.where(k < dims[:, None], first[:, None] + k, -1)
    others = np.setdiff1d(np.arange(impl.efc_J.shape[0]), index)
    mu = contact.friction[:, 0] / jnp.sqrt(m.opt.impratio)
    scale = jnp.concatenate([mu[:, None], contact.friction], -1)[:, : len(k)] * (index >= 0)
    problem = _Problem(
        mass=support.full_m(m, d),
        free=d.qacc_smooth,
        force=d.qfrc_smooth,
        rows=impl.efc_J[others],
        goal=impl.efc_aref[others],
        weight=impl.efc_D[others],
        always=jnp.asarray(others < impl.ne),
        cones=scale[:, :, None] * impl.efc_J[index],
        cone_goal=scale * impl.efc_aref[index],
        stiffness=impl.efc_D[first] / jnp.maximum(mu**2, TINY),
        mu=mu,
    )
    return problem, index, scale


def solve(m: Any, d: Any) -> Any:
    """Compute the constraint forces and accelerations of one state.

    Args:
      m: MJX model (JAX implementation, Newton, elliptic cone, no friction loss).
      d: its data, up to `forward.fwd_acceleration`.

    Returns:
      `d` with `qacc`, `qfrc_constraint` and `efc_force`. The force is the one that the acceleration needs, so that an
      implicit integrator, which starts from forces, does not multiply what is left of the gradient.
    """
    p, index, scale = _problem(m, d)
    better = _cost(p, d.qacc_warmstart) < _cost(p, d.qacc_smooth)
    start = jnp.where(better, d.qacc_warmstart, d.qacc_smooth)
    a = _minimize(p, start, int(m.opt.iterations), int(m.opt.ls_iterations))
    x, u = _residuals(p, a)
    push = -p.stiffness[:, None] * _reach(u, p.mu).away * scale
    others = np.setdiff1d(np.arange(d._impl.efc_J.shape[0]), index)
    force = jnp.zeros_like(d._impl.efc_aref).at[others].set(-_pushing(p, x) * x)
    force = force.at[np.where(index < 0, len(force), index)].set(push, mode="drop")
    return d.tree_replace({"qacc": a, "qfrc_constraint": p.mass @ a - p.force, "_impl.efc_force": force})


def is_supported(m: Any, d: Any) -> bool:
    """Return whether `solve` can solve this model: elliptic cones, Newton, no friction loss, contacts with friction."""
    elliptic = m.opt.cone == ConeType.ELLIPTIC and m.opt.solver == SolverType.NEWTON
    return elliptic and not d._impl.nf and len(d._impl.contact.dim) > 0 and min(d._impl.contact.dim) > 1
