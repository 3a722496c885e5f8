"""The control period as one kernel: its parts and the whole compared with MJX, with 32 lanes and with one."""

from __future__ import annotations

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from eventful import MOST, PERIODS, SLOTS, scenes_with_control
from mujoco.mjx._src import forward, support

from dipn_jax.physics import cone, mjx, patches, tick
from dipn_jax.physics.mjx_program import Program
from dipn_jax.physics.recording import State
from dipn_jax.structs import ABSENT, Fault, Scene
from dipn_jax.world import primitives, scenes

pytestmark = pytest.mark.slow
SUBSTEPS = 4
STATIC_SHARED_MEMORY = 48 * 1024
"""Bytes that a CUDA kernel may have without asking at run time."""
MOST_REGISTERS = 128
"""With more, fewer than 16 warps fit a multiprocessor (65,536 registers)."""


@dataclasses.dataclass
class Recorded:
    """States on the way of the recorded scenes, every fifth control period: `[B, ...]`, all scenes at once first."""

    scene: Scene
    state: State
    control: np.ndarray
    push: np.ndarray
    after: State  # a control period later, by the kernel
    leaves: dict[str, np.ndarray]  # all that the kernel is given, by its arguments' names


@pytest.fixture(scope="module")
def kernel() -> Program:
    return Program(dataclasses.replace(mjx.DEFAULTS, solver="warp"), SLOTS, SUBSTEPS)


@pytest.fixture(scope="module")
def recorded(kernel: Program) -> Recorded:
    scene, poses, control = scenes_with_control()
    push = np.zeros((len(poses), 6 + 6 * SLOTS), np.float32)
    push[:, 6] = 0.02
    fields = jax.jit(jax.vmap(kernel._fields))(scene)
    advance = jax.jit(jax.vmap(kernel._tick))
    state = jax.vmap(kernel._initial)(poses, control[0])
    seen = []
    rng, blow = np.random.default_rng(0), np.array([0.1, 0.1, 0.1, 3, 0.3, 0.3])
    for period in range(PERIODS):
        if period % 5 == 4:  # the last scene's hand turns, and its fingers move unlike one another
            state = state.replace(qvel=state.qvel.at[-1, :6].add(rng.normal(size=6) * blow))
        after = advance(fields, state, control[period], push)
        if period % 5 == 4:
            seen.append((scene, state, control[period], push, after, jax.vmap(tick.scene_fields)(fields)))
        state = after
    scene, state, control, push, after, leaves = jax.tree.map(lambda *each: np.concatenate(each), *seen)
    leaves |= {name: getattr(state, name) for name in ("qpos", "qvel", "warmstart")}
    return Recorded(scene, state, control, push, after, leaves | {"control": control, "push": push})


def _on_diagonal(blocks: np.ndarray) -> np.ndarray:
    """Return matrices `[B, N, 6, N, 6]` with `blocks [B, N, 6, 6]` on their diagonals."""
    return np.einsum("bnij,nm->bnimj", blocks, np.eye(blocks.shape[1]))


def _compare_contacts(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> set[str]:
    """Compare contacts, which are in any order; return what they move."""
    near = np.abs(found["cones"][:, None] - wanted["cones"]).max((-1, -2)).argmin(-1)
    assert len(set(near)) == len(near)
    for name, most in (("cones", 1e-6), ("cone_goal", 1e-3), ("stiffness", 1e-4), ("mu", 1e-6)):
        want = wanted[name][near]
        np.testing.assert_allclose(found[name], want, atol=most * np.abs(want).max(), err_msg=name)
    columns = np.abs(found["cones"]).max(1) > 0
    objects = columns[:, 6:].reshape(len(columns), -1, 6).any(-1).sum(-1)
    moves = dict(zip(("yaw", "left", "right"), columns[:, 3:6].T, strict=True))
    moves |= {"an object": objects == 1, "two objects": objects == 2}
    return {name for name, which in moves.items() if which.any()}


@pytest.fixture(scope="module")
def by_mjx(recorded: Recorded) -> tuple[State, dict[str, Any]]:
    """Return the states a control period later, and what the solver is given before it, both by MJX in XLA."""
    patches.register()
    program = Program(mjx.DEFAULTS, SLOTS, SUBSTEPS)

    def one(scene: Scene, state: State, control: jax.Array, push: jax.Array) -> tuple[State, dict[str, Any]]:
        fields = program._fields(scene)
        m = program.base.tree_replace(fields)
        d = program.data.replace(qpos=state.qpos, qvel=state.qvel, ctrl=control, qfrc_applied=push)
        for stage in (forward.fwd_position, forward.fwd_velocity, forward.fwd_actuation, forward.fwd_acceleration):
            d = stage(m, d)
        p = cone._problem(m, d)[0]
        given = vars(p) | {"mass": support.full_m(m, d), "place": d.geom_xpos}
        return program._substep(m, control, push, state), given

    step, state, given = jax.jit(jax.vmap(one)), recorded.state, []
    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
        for _ in range(SUBSTEPS):
            state, before = step(recorded.scene, state, recorded.control, recorded.push)
            given.append(before)
    return jax.tree.map(np.asarray, (state, given[0]))


def _assert_alike(found: Any, wanted: Any) -> None:
    """Check that states `[B]` are alike.

    That is within rounding in four of five; in the others a sum in another order decides whether something slips.
    """
    for name, most, usual in (("qpos", 1e-5, 5e-7), ("qvel", 0.01, 1e-5), ("depth", 1e-6, 1e-8)):
        each = np.abs(np.asarray(getattr(found, name)) - getattr(wanted, name)).reshape(len(wanted.qpos), -1).max(-1)
        assert each.max() < most and np.quantile(each, 0.8) < usual, (name, each)
    warm = np.abs(np.asarray(found.warmstart) - wanted.warmstart).max(-1)
    assert np.quantile(warm, 0.8) < 1e-5 * np.abs(wanted.warmstart).max()
    assert not np.asarray(found.full).any() and not wanted.full.any()


def test_a_period_ends_where_that_of_mjx_does(recorded: Recorded, by_mjx: tuple[State, dict[str, Any]]) -> None:
    _assert_alike(recorded.after, by_mjx[0])
    moved = np.abs(by_mjx[0].qpos - recorded.state.qpos).max(-1)
    assert (moved > 3e-4).sum() > 15, "they move"


def test_the_solver_is_given_what_mjx_gives_it(
    kernel: Program, recorded: Recorded, by_mjx: tuple[State, dict[str, Any]]
) -> None:
    import tick_kernels

    assert kernel.kernel is not None
    found, wanted = tick_kernels.look(kernel.kernel.numbers, recorded.leaves), by_mjx[1]
    batch, blocks = len(recorded.push), SLOTS + 1
    whole = wanted["mass"].reshape(batch, blocks, 6, blocks, 6)
    np.testing.assert_allclose(_on_diagonal(found["mass"]), whole, atol=1e-7)
    for name in ("place", "force", "free", "row", "goal", "weight"):
        want = wanted["rows"][..., :6] if name == "row" else wanted[name]
        np.testing.assert_allclose(found[name], want, atol=1e-5 * np.abs(want).max(), err_msg=name)
    assert (wanted["weight"] > 0).all() and (np.abs(wanted["rows"]).sum(-1) > 0).any(0).all(), "all rows hold sometimes"
    touched = set()
    for b in range(batch):
        ours, theirs = found["stiffness"][b] > 0, np.abs(wanted["cones"][b]).sum((1, 2)) > 0
        assert ours.sum() == theirs.sum()
        if ours.any():
            touched |= _compare_contacts(*(
                {name: given[name][b][which] for name in ("cones", "cone_goal", "stiffness", "mu")}
                for given, which in ((found, ours), (wanted, theirs))
            ))  # fmt: skip
    assert touched >= {"left", "right", "yaw", "an object", "two objects"}


def test_a_scene_has_the_same_bits_whatever_its_batch_and_in_every_run(kernel: Program, recorded: Recorded) -> None:
    import tick_kernels

    assert kernel.kernel is not None
    turned = {name: leaf[::-1] for name, leaf in recorded.leaves.items()}
    again = tick_kernels.advance(kernel.kernel.numbers, turned, substeps=SUBSTEPS, lanes=1)
    for name in ("qpos", "qvel", "warmstart"):
        np.testing.assert_array_equal(again[name][::-1], getattr(recorded.after, name))
    np.testing.assert_array_equal(again["depth"][::-1, 0], recorded.after.depth)


def test_empty_slots_change_nothing_though_their_kernel_is_the_large_one(recorded: Recorded) -> None:
    wide, more, state = 8, 5, recorded.state
    assert tick.capacity(wide, MOST) == tick.CAPACITIES[-1] != tick.capacity(SLOTS, MOST)
    program = Program(dataclasses.replace(mjx.DEFAULTS, solver="warp"), wide, SUBSTEPS)

    def padded(leaf: np.ndarray, fill: float) -> np.ndarray:
        return np.pad(leaf, ((0, 0), (0, more), *[(0, 0)] * (leaf.ndim - 2)), constant_values=fill)

    filled = zip(jax.tree.leaves(recorded.scene), (ABSENT, 0.05, 0.0, 0.1, 0.3), strict=True)
    scene = jax.tree.unflatten(jax.tree.structure(recorded.scene), [padded(*each) for each in filled])
    parked = np.broadcast_to(np.asarray(scenes.parked(wide))[SLOTS:].ravel(), (len(state.qpos), 7 * more))
    zeros = np.zeros((len(state.qpos), 6 * more), np.float32)
    names = ("qpos", "qvel", "warmstart")
    longer = {name: np.concatenate([getattr(state, name), zeros if name != "qpos" else parked], 1) for name in names}
    push = np.concatenate([recorded.push, zeros], 1)
    fields = jax.jit(jax.vmap(program._fields))(scene)
    found = jax.jit(jax.vmap(program._tick))(fields, state.replace(**longer), recorded.control, push)
    shorter = {name: getattr(found, name)[:, : getattr(state, name).shape[1]] for name in names}
    _assert_alike(found.replace(**shorter), recorded.after)


def test_lanes_wait_for_one_another(kernel: Program, recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fibers run one after the other up to each barrier, so where one is missing they read what is not there yet."""
    import tick_kernels
    import warp

    assert kernel.kernel is not None
    monkeypatch.setattr(warp.config, "enable_cpu_blocks", True)
    together, again = (
        tick_kernels.advance(kernel.kernel.numbers, recorded.leaves, substeps=SUBSTEPS, lanes=32) for _ in range(2)
    )
    alike = {name: leaf.reshape(getattr(recorded.after, name).shape) for name, leaf in together.items()}
    _assert_alike(types.SimpleNamespace(**alike), recorded.after)
    for name, leaf in again.items():
        np.testing.assert_array_equal(leaf, together[name])


@pytest.mark.parametrize("rooms", tick.CAPACITIES)
def test_on_a_gpu_nothing_is_spilled_and_its_shared_memory_is_static(
    rooms: tuple[int, int], kernel: Program, tmp_path: Any
) -> None:
    import cubin
    import warp

    assert kernel.kernel is not None
    module = tick.load().kernel(*rooms, kernel.kernel.numbers).module
    (path,) = warp.compile_aot_module(module, arch=90, use_ptx=False, module_dir=tmp_path, strip_hash=None)
    used = cubin.resources(path.read_bytes())
    assert used.stack == 0, "registers or arrays are in local memory"
    assert used.registers <= MOST_REGISTERS
    assert 0 < used.shared <= STATIC_SHARED_MEMORY


def test_a_call_is_the_first_of_its_name() -> None:
    """Where it is not, another process has another program, and compiles it again."""
    slots, substeps = 2, 3  # as nothing else has, for a number counts the traces of all programs of one size
    made = Program(dataclasses.replace(mjx.DEFAULTS, solver="warp"), slots, substeps)
    assert made.kernel is not None
    scene, poses, control = (jax.tree.map(lambda leaf: leaf[0], each) for each in scenes_with_control())
    state = made._initial(jnp.asarray(poses[:slots]), control[0])
    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):  # as engines trace
        fields = tick.scene_fields(made._fields(jax.tree.map(lambda leaf: jnp.asarray(leaf[:slots]), scene)))
        text = jax.jit(made.kernel.advance).lower(fields, state, control[0], jnp.zeros(6 + 6 * slots)).as_text()
    assert f"@tick_{slots + 1}_{MOST}_{substeps}_50_50_0(" in text and "launch_id = 0 " in text, text


def test_contacts_that_are_left_out_and_what_is_not_finite_are_faults_of_their_own_scene() -> None:
    size, flat = np.full((2, 1, 3), 0.05, np.float32), np.full((2, 1), 0.35, np.float32)
    box = Scene(np.zeros((2, 1), np.int32), size, size, flat, flat)
    pose = np.array([[[0, 0, 0.0249, 1, 0, 0, 0]], [[0, 0, 0.2, 1, 0, 0, 0]]], np.float32)
    for most, wanted in ((4, True), (5, False)):
        config = dataclasses.replace(mjx.DEFAULTS, solver="warp", contact_points=(most, 0))
        engine = mjx.MjxEngine(config)
        rollout = primitives.settle(engine, box, pose, duration=0.01)
        assert ((rollout.fault & Fault.CAPACITY) > 0).tolist() == [wanted, False]
    pose[0, 0, 2] = np.nan
    broken = primitives.settle(engine, box, pose, duration=0.01)
    assert ((broken.fault & Fault.NON_FINITE) > 0).tolist() == [True, False]
    np.testing.assert_array_equal(broken.poses[1], rollout.poses[1])


def test_a_set_point_that_is_not_finite_is_no_force(kernel: Program, recorded: Recorded) -> None:
    import tick_kernels

    assert kernel.kernel is not None
    control = np.array(recorded.control)
    control[0, 0] = np.nan
    given = recorded.leaves | {"control": control}
    found = tick_kernels.advance(kernel.kernel.numbers, given, substeps=SUBSTEPS, lanes=1)
    assert np.isnan(found["qpos"][0, 0]), "else the hand is driven at full force, without a fault"
    np.testing.assert_array_equal(found["qpos"][1:], recorded.after.qpos[1:])
