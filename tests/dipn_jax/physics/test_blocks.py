"""The solver of blocks compared with SciPy and with `cone`, with 32 lanes and with one, and as a GPU would run it."""

from __future__ import annotations

import sys
from typing import Any

import cone_cost
import jax
import numpy as np
import pytest
import scipy.optimize
from mujoco.mjx._src import forward

from dipn_jax import physics
from dipn_jax.errors import UserError
from dipn_jax.physics import blocks, cone, mjx, patches
from dipn_jax.physics.mjx_program import Program
from dipn_jax.structs import Scene
from dipn_jax.world import primitives

pytestmark = pytest.mark.slow
BLOCKS = 4
CONTACTS = 9
ROWS = 3
STATIC_SHARED_MEMORY = 48 * 1024
"""Bytes that a CUDA kernel may have without asking at run time."""
MOST_REGISTERS = 128
"""With more, fewer than 16 warps fit a multiprocessor (65,536 registers)."""


def _problem(rng: np.random.Generator, *, sticking: bool) -> blocks.Problem:
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
    return blocks.Problem(**{name: np.float32(leaf) for name, leaf in floats.items()}, side=side, equalities=1)


def _dense(p: blocks.Problem) -> cone._Problem:
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
    solve = jax.jit(lambda p, start: blocks.minimize(p, start, 50, 50))
    rng = np.random.default_rng(0)
    for _ in range(10):
        p = _problem(rng, sticking=sticking)
        found, steps = (np.asarray(x, float) for x in solve(p, np.zeros(6 * BLOCKS, np.float32)))
        exact = cone_cost.exact(_dense(p))
        best = scipy.optimize.minimize(lambda a, p=exact: cone_cost.cost(p, a), found, method="BFGS")
        assert cone_cost.cost(exact, exact.free) > 2 * best.fun, "constraints matter"
        assert cone_cost.cost(exact, found) <= best.fun * (1 + 1e-5)
        assert 1 < steps < 30


def test_a_step_is_that_of_dense_rows_and_ends_where_the_slope_is_small() -> None:
    problems = [_problem(np.random.default_rng(seed), sticking=False) for seed in range(20)]
    moved, _ = _launched(problems, 1, iterations=1)
    newton = jax.jit(cone._newton)
    for p, a in zip(problems, moved, strict=True):
        dense = _dense(p)
        step = np.asarray(newton(dense, p.free)[2], float)
        multiple = (a - p.free) @ step / (step @ step)
        np.testing.assert_allclose(a - p.free, multiple * step, atol=1e-3 * np.abs(multiple * step).max())
        exact, h = cone_cost.exact(dense), 1e-4
        at = [cone_cost.cost(exact, p.free + t * step) for t in (-h, h, multiple - h, multiple + h)]
        assert abs(at[3] - at[2]) < 1.1 * cone.FLAT_SLOPE * abs(at[1] - at[0])


def _state(m: Any, data: Any, qpos: jax.Array, qvel: jax.Array) -> Any:
    """Return the data of a state as the solver is given it."""
    d = data.replace(qpos=qpos, qvel=qvel)
    for stage in (forward.fwd_position, forward.fwd_velocity, forward.fwd_actuation, forward.fwd_acceleration):
        d = stage(m, d)
    return d


@pytest.fixture(scope="module")
def states() -> tuple[blocks.Problem, cone._Problem]:
    """Return both forms of problems of MJX `[8]`: a hand that holds a cuboid on which a cylinder lies."""
    patches.register()
    program = Program(mjx.DEFAULTS, 2, substeps=1)
    size = np.array([[0.06, 0.05, 0.04], [0.048, 0.05, 0.048]], np.float32)
    scene = Scene(np.arange(2, dtype=np.int32), size, 0 * size, np.full(2, 0.06), np.full(2, 0.35))

    def both(qpos: jax.Array, qvel: jax.Array) -> tuple[blocks.Problem, cone._Problem]:
        m = program.base.tree_replace(program._fields(scene))
        d = _state(m, program.data, qpos, qvel)
        return blocks.problem(m, d), cone._problem(m, d)[0]

    qpos = np.array([0, 0, 0.01, 0, 0.0295, 0.0299, 0, 0, 0.0195, 1, 0, 0, 0, 0, 0.01, 0.063, 1, 0, 0, 0])
    qvel = np.random.default_rng(0).normal(size=(8, 18)) * 0.1
    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
        made = jax.jit(jax.vmap(both, (None, 0)))(np.float32(qpos), np.float32(qvel))
    return jax.tree.map(np.asarray, made)


def test_the_problem_of_a_state_is_that_of_its_dense_rows(states: tuple[blocks.Problem, cone._Problem]) -> None:
    for i in range(8):
        p, wanted = (jax.tree.map(lambda leaf, i=i: leaf[i], each) for each in states)
        found, touching = _dense(p), p.stiffness > 0
        assert {-1, 0, 1, 2} == set(p.side[touching].ravel() // 8), "the table, the hand and both objects touch"
        assert len(set(p.side[touching].ravel() % 8)) > 2, "both fingers"
        for name in vars(wanted):
            rows = touching if name in ("cones", "cone_goal", "stiffness", "mu") else slice(None)
            got, want = getattr(found, name)[rows], getattr(wanted, name)[rows]
            np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5 * np.abs(want).max(), err_msg=name)


def test_a_state_of_mjx_gets_the_acceleration_that_dense_rows_give(
    states: tuple[blocks.Problem, cone._Problem],
) -> None:
    start = np.zeros_like(states[0].free)
    # as the engine does, or the program of the engine's test is traced, and compiled, otherwise in a session of its own
    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
        found, _ = jax.jit(jax.vmap(lambda p, a: blocks.minimize(p, a, 50, 50)))(states[0], start)
        wanted = jax.jit(jax.vmap(lambda p, a: cone._minimize(p, a, 50, 50)))(states[1], start)
    for i in range(8):
        exact = cone_cost.exact(jax.tree.map(lambda leaf, i=i: leaf[i], states[1]))
        ours, theirs = (cone_cost.cost(exact, np.asarray(a[i], float)) for a in (found, wanted))
        assert ours <= theirs * (1 + 1e-5)
    np.testing.assert_allclose(found, wanted, atol=1e-3 * np.abs(wanted).max())


def _launched(problems: list[blocks.Problem], lanes: int, iterations: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Return accelerations `[B, V]` and steps `[B]` of the kernel launched with that many lanes on the CPU."""
    import warp

    names = list(blocks.ARGUMENTS)
    leaves = [np.stack([getattr(p, name) for p in problems]) for name in names]
    arrays = [warp.array(leaf.ravel(), dtype=warp.int32 if leaf.dtype.kind == "i" else float) for leaf in leaves]
    start = warp.full(problems[0].free.size * len(problems), float("nan"), dtype=float)  # so it begins at `free`
    out, steps = warp.zeros_like(start), warp.zeros(len(problems), dtype=warp.int32)
    numbers = [BLOCKS, CONTACTS, ROWS, 1, iterations, 50]
    native = blocks.load()
    kernel = native.kernel(*blocks.CAPACITIES[0])
    inputs = [*arrays, start, *numbers, out, steps]
    warp.launch(kernel, dim=(len(problems), native.LANES), inputs=inputs, block_dim=lanes, device="cpu")
    return out.numpy().reshape(len(problems), -1), steps.numpy()


def test_lanes_wait_for_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fibers run one after the other up to each barrier, so where one is missing they read what is not there yet."""
    import warp

    problems = [_problem(np.random.default_rng(seed), sticking=False) for seed in range(20)]
    alone, steps_alone = _launched(problems, 1)
    monkeypatch.setattr(warp.config, "enable_cpu_blocks", True)
    together, steps = _launched(problems, 32)
    np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(steps, steps_alone)
    np.testing.assert_array_equal(_launched(problems, 32)[0], together)


@pytest.mark.parametrize("rooms", blocks.CAPACITIES)
def test_on_a_gpu_nothing_is_spilled_and_its_shared_memory_is_static(
    rooms: tuple[int, int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    import cubin
    import warp

    kernel = blocks.load().kernel(*rooms)
    (path,) = warp.compile_aot_module(
        kernel.module, arch=90, use_ptx=False, module_dir=tmp_path_factory.mktemp("cubin"), strip_hash=None
    )
    used = cubin.resources(path.read_bytes())
    assert used.stack == 0, "registers or arrays are in local memory"
    assert used.registers <= MOST_REGISTERS
    assert 0 < used.shared <= STATIC_SHARED_MEMORY


def test_without_warp_it_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(UserError, match=r"solver warp: .*dipn-jax\[warp\].* or solver xla$") as error:
        physics.make_engine("mjx_warp")
    assert "\n" not in str(error.value)


def test_more_objects_or_contacts_than_there_is_room_for_are_refused() -> None:
    assert [blocks.capacity(*size) for size in ((7, 80), (8, 80), (14, 112))] == [(8, 80), (15, 112), (15, 112)]
    for size in ((15, 112), (7, 113), (7, -1)):
        with pytest.raises(UserError, match=r"object slots and .* contacts a scene; want at most 14 and 112"):
            blocks.capacity(*size)
    size, full = np.full((1, 15, 3), 0.05, np.float32), np.full((1, 15), 0.35, np.float32)
    crowd = Scene(np.zeros((1, 15), np.int32), size, size, full, full)
    with pytest.raises(UserError, match="15 object slots"):
        primitives.settle(physics.make_engine("mjx_warp"), crowd, np.zeros((1, 15, 7), np.float32), duration=0.01)


def test_it_is_an_option_and_runs_where_warp_does() -> None:
    assert physics.make_engine("mjx").config == mjx.DEFAULTS and mjx.DEFAULTS.solver == "xla"
    with pytest.raises(UserError, match="solver warp: JAX computes on tpu; want cpu or gpu, or solver xla"):
        blocks.check("tpu")
