"""The contact solver of the kernel of `tick` compared with SciPy and with `cone`, with 32 lanes and with one."""

from __future__ import annotations

import cone_cost
import jax
import numpy as np
import pytest
import scipy.optimize
import solver_kernel
from solver_kernel import Problem

from dipn_jax.physics import cone

pytestmark = pytest.mark.slow
BLOCKS = 4
CONTACTS = 9
ROWS = 3


def _problem(rng: np.random.Generator, *, sticking: bool) -> Problem:
    """Make random bodies with masses a thousandfold apart and contacts between any two of them or with the table."""
    spread = 10 ** rng.uniform(-1.5, 1.5, (BLOCKS, 6))
    basis = rng.normal(size=(BLOCKS, 6, 6))
    mass = (basis @ basis.swapaxes(1, 2) / 6 + np.eye(6)) * np.sqrt(spread[:, :, None] * spread[:, None])
    free = rng.normal(size=(BLOCKS, 6)) * 10
    pairs = np.stack([rng.permutation(BLOCKS)[:2] for _ in range(CONTACTS)])
    side = np.where(rng.random((CONTACTS, 2)) < [0.3, 0], -1, 8 * pairs + rng.integers(0, 8, pairs.shape))
    side = rng.permuted(side, axis=1).astype(np.int32)
    floats = {
        "mass": mass,
        "free": free.ravel(),
        "force": (mass @ free[..., None]).ravel(),
        "velocity": rng.normal(size=6 * BLOCKS) * (not sticking),
        "center": rng.normal(size=(BLOCKS, 3)),
        "axes": rng.normal(size=(BLOCKS, 3, 6)),
        "row": rng.normal(size=(ROWS, 6)),
        "row_goal": rng.normal(size=ROWS),
        "row_weight": 10 ** rng.uniform(0, 3, ROWS),
        "position": rng.normal(size=(CONTACTS, 3)),
        "frame": np.linalg.qr(rng.normal(size=(CONTACTS, 3, 3)))[0],
        "scale": np.tile([0.16, 0.5, 0.5], (CONTACTS, 1)),
        "stiffness": 10 ** rng.uniform(1, 4, CONTACTS) * (rng.random(CONTACTS) < 0.8),
        "damping": rng.uniform(0, 3, CONTACTS),
        "bias": rng.normal(size=CONTACTS) * 30,
    }
    return Problem(**{name: np.float32(leaf) for name, leaf in floats.items()}, side=side, equalities=1)


def _dense(p: Problem) -> cone._Problem:
    """Return the same problem with dense rows."""
    size = p.free.size
    jacobian = np.zeros((len(p.side), 3, size))
    for c, which in np.argwhere(p.side >= 0):
        block, bits = divmod(int(p.side[c, which]), 8)
        columns = np.zeros((3, 6))
        columns[:, :3] = np.eye(3)
        for i in range(3):
            turn, shift = p.axes[block, i, :3].astype(float), p.axes[block, i, 3:]
            columns[:, 3 + i] = (shift + np.cross(turn, p.position[c] - p.center[block])) * (bits >> i & 1)
        jacobian[c, :, 6 * block : 6 * block + 6] = (2 * which - 1) * p.frame[c] @ columns
    goal = -p.damping[:, None] * (jacobian @ p.velocity) - p.bias[:, None] * [1, 0, 0]
    made = cone._Problem(
        mass=np.einsum("bij,bc->bicj", p.mass, np.eye(len(p.mass))).reshape(size, size),
        free=p.free,
        force=p.force,
        rows=np.pad(p.row, ((0, 0), (0, size - 6))),
        goal=p.row_goal,
        weight=p.row_weight,
        always=np.arange(len(p.row)) < p.equalities,
        cones=p.scale[..., None] * jacobian,
        cone_goal=p.scale * goal,
        stiffness=p.stiffness,
        mu=p.scale[:, 0],
    )
    return jax.tree.map(lambda x: np.asarray(x, bool if np.asarray(x).dtype == bool else np.float32), made)


@pytest.mark.parametrize("sticking", [False, True])
def test_the_least_cost_is_found_in_float32(sticking: bool) -> None:
    rng = np.random.default_rng(0)
    problems = [_problem(rng, sticking=sticking) for _ in range(10)]
    for p, found, steps in zip(problems, *solver_kernel.minimize(problems), strict=True):
        exact = cone_cost.exact(_dense(p))
        best = scipy.optimize.minimize(lambda a, p=exact: cone_cost.cost(p, a), found, method="BFGS")
        assert cone_cost.cost(exact, exact.free) > 2 * best.fun, "constraints matter"
        assert cone_cost.cost(exact, found) <= best.fun * (1 + 1e-5)
        assert 1 < steps < 30


def test_a_step_is_that_of_dense_rows_and_ends_where_the_slope_is_small() -> None:
    problems = [_problem(np.random.default_rng(seed), sticking=False) for seed in range(20)]
    moved, _ = solver_kernel.minimize(problems, iterations=1)
    newton = jax.jit(cone._newton)
    for p, a in zip(problems, moved, strict=True):
        dense = _dense(p)
        step = np.asarray(newton(dense, p.free)[2], float)
        multiple = (a - p.free) @ step / (step @ step)
        np.testing.assert_allclose(a - p.free, multiple * step, atol=1e-3 * np.abs(multiple * step).max())
        exact, h = cone_cost.exact(dense), 1e-4
        at = [cone_cost.cost(exact, p.free + t * step) for t in (-h, h, multiple - h, multiple + h)]
        assert abs(at[3] - at[2]) < 1.1 * cone.FLAT_SLOPE * abs(at[1] - at[0])


def test_lanes_wait_for_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fibers run one after the other up to each barrier, so where one is missing they read what is not there yet."""
    import warp

    problems = [_problem(np.random.default_rng(seed), sticking=False) for seed in range(20)]
    alone, steps_alone = solver_kernel.minimize(problems)
    monkeypatch.setattr(warp.config, "enable_cpu_blocks", True)
    together, steps = solver_kernel.minimize(problems, lanes=32)
    np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(steps, steps_alone)
    np.testing.assert_array_equal(solver_kernel.minimize(problems, lanes=32)[0], together)
