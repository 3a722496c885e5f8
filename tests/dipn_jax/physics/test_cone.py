"""The solver for elliptic cones compared with SciPy, on the cost that MuJoCo's documentation gives."""

import cone_cost
import jax
import numpy as np
import pytest
import scipy.optimize

from dipn_jax.physics import cone

V = 9
"""Degrees of freedom."""
ROWS = 3
"""Quadratic rows."""
CONES = 4
"""Contacts."""


def _problem(rng: np.random.Generator, *, sticking: bool) -> cone._Problem:
    """Make random bodies with masses a thousandfold apart; where they stick, the free acceleration is tangential."""
    spread = 10 ** rng.uniform(-1.5, 1.5, V)
    basis = rng.normal(size=(V, V))
    mass = (basis @ basis.T / V + np.eye(V)) * np.sqrt(spread[:, None] * spread)
    free = rng.normal(size=V) * 10
    goal = rng.normal(size=(CONES, 3)) * ([5, 0, 0] if sticking else [5, 1, 1])
    made = cone._Problem(
        mass=mass,
        free=free,
        force=mass @ free,
        rows=rng.normal(size=(ROWS, V)),
        goal=rng.normal(size=ROWS),
        weight=10 ** rng.uniform(0, 3, ROWS),
        always=np.arange(ROWS) < 1,
        cones=rng.normal(size=(CONES, 3, V)) * np.array([0.16, 0.5, 0.5])[:, None],
        cone_goal=goal,
        stiffness=10 ** rng.uniform(1, 4, CONES),
        mu=np.full(CONES, 0.16),
    )
    return jax.tree.map(lambda x: np.asarray(x, bool if np.asarray(x).dtype == bool else np.float32), made)


@pytest.mark.parametrize("sticking", [False, True])
def test_the_least_cost_is_found_in_float32(sticking: bool) -> None:
    solve = jax.jit(lambda p, start: cone._minimize(p, start, 50, 50))
    rng = np.random.default_rng(0)
    for _ in range(20):
        p = _problem(rng, sticking=sticking)
        with jax.default_matmul_precision("highest"):  # as the engine does: accelerators else shorten products
            found = np.asarray(solve(p, np.zeros(V, np.float32)), float)
        exact = cone_cost.exact(p)
        best = scipy.optimize.minimize(
            lambda a, p=exact: cone_cost.cost(p, a), found, method="BFGS", options={"gtol": 1e-9}
        )
        assert cone_cost.cost(exact, np.asarray(p.free)) > 2 * best.fun, "constraints matter"
        assert cone_cost.cost(exact, found) <= best.fun * (1 + 1e-5), (cone_cost.cost(exact, found), best.fun)


@pytest.mark.parametrize("multiple", [1e-3, 0.3, 1.0, 10.0, 1000.0])
def test_the_line_search_finds_minima_near_and_far(multiple: float) -> None:
    p = _problem(np.random.default_rng(1), sticking=False)
    p = p.replace(weight=np.zeros(ROWS, np.float32), stiffness=np.zeros(CONES, np.float32))  # a parabola
    step = (p.free / multiple).astype(np.float32)
    slope = -p.force @ step
    found = jax.jit(cone._line_search)(p, np.zeros(V, np.float32), step, slope, 50, np.bool_(False))
    assert abs(found / multiple - 1) < 0.1
    assert jax.jit(cone._line_search)(p, np.zeros(V, np.float32), step, slope, 50, np.bool_(True)) == 0
