"""Stages of `on_gpu` that check results: shipped networks, engines against MuJoCo C, the same run twice."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from dipn_jax.datagen import world
from dipn_jax.eval.clearing import instances, on_tables

from benchmarks.deciding import BUILTIN
from benchmarks.gpu_engines import engine, make_ready
from benchmarks.gpu_stage import NotMeasured, Size, Wrong, installed
from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.names import EngineName
from dipn_jax.planning import methods
from dipn_jax.planning.planner import NONE_MISSED
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.structs import Decision, Fault
from dipn_jax.world import cases, clutter, primitives

LEAST_EQUAL = 0.95
"""Share of grasps that end as in MuJoCo C, below which an engine is wrong."""
REPEATED_SECONDS = 0.5
"""Seconds that are simulated twice."""
Found = Iterator[tuple[str, float | str]]


@functools.cache
def policy(size: Size) -> on_tables.TablePolicy:
    """Return the shipped networks as a policy of many tables, which considers `size.candidates` pushes on each."""
    config = PolicyConfig(candidates=size.candidates, grasp_above=1.0)
    networks = methods.Networks(BUILTIN, BUILTIN)
    (decide,) = on_tables.load("dipn+gn", networks, engine("native", size), [config])
    return decide


@functools.cache
def table_slots() -> int:
    """Return the number of object slots of the hard tables; all tables have as many, so that one program decides."""
    return int(cases.load_cases(cases.hard_cases_path())[1].shape.shape[1])


def recall_nothing(heights: Any) -> np.ndarray:
    """Return an empty memory of misses for these height maps `[B, H, W]`."""
    return np.repeat(NONE_MISSED[None], len(heights), 0)


def weights(size: Size) -> Found:
    """Decide on hard tables by the shipped networks, on the device, and make each action in MuJoCo C.

    Raises:
      Wrong: a score is no chance, or a simulation goes wrong.
    """
    native, path = engine("native", size), cases.hard_cases_path()
    names, slots = cases.load_cases(path)[0], table_slots()
    tables = instances.case_instances(native, path, names[: size.cases], slots=slots, repeats=1, seed=size.seed)
    scene, poses = structs.stack([table.scene for table in tables]), np.stack([table.poses for table in tables])
    keys = jax.random.split(jax.random.key(size.seed), len(tables))
    decision, _ = policy(size)(keys, scene, poses, recall_nothing)
    check_scores(decision)
    ended, held = _act(native, scene, poses, decision)
    yield "pushes", float(np.mean(decision.is_push))
    yield "grasps_held", float(held.mean()) if len(held) else np.nan
    if not ended.all():
        raise Wrong(f"actions on {int((~ended).sum())} of {len(ended)} hard tables ended with a fault; want none")
    yield "", float(ended.mean())


def check_scores(decision: Decision) -> None:
    """Raise `Wrong` where the score of a table's best grasp is not in [0, 1]."""
    score = np.asarray(decision.grasp_score)
    if not ((score >= 0) & (score <= 1)).all():
        raise Wrong(f"scores of grasps from {score.min():g} to {score.max():g}; want 0 to 1")


def _act(engine: Engine, scene: Any, poses: np.ndarray, decision: Decision) -> tuple[np.ndarray, np.ndarray]:
    """Make each table's action; return which of them ended without a fault `[B]`, and which grasps held."""
    is_push, ended = np.asarray(decision.is_push), np.zeros(len(poses), bool)
    held: np.ndarray = np.zeros(0, bool)
    pushed, grasped = np.flatnonzero(is_push), np.flatnonzero(~is_push)
    if len(pushed):
        rollout = primitives.push(
            engine, structs.take(scene, pushed), poses[pushed], structs.take(decision.push, pushed)
        )
        ended[pushed] = Fault.usable(rollout.fault)
    if len(grasped):
        _, _, found, fault = clutter.grasp_away(
            engine, structs.take(scene, grasped), poses[grasped], structs.take(decision.grasp, grasped)
        )
        ended[grasped] = Fault.usable(fault)
        held = np.atleast_1d(found.any(-1))
    return ended, held


def agreement_mjx(size: Size) -> Found:
    """Measure MJX against MuJoCo C; see `_agreement`."""
    yield from _agreement("mjx", size)


def agreement_mjx_warp(size: Size) -> Found:
    """Measure `mjx_warp`, whose time steps a Warp kernel computes, against MuJoCo C; see `_agreement`."""
    yield from _agreement("mjx_warp", size)


def agreement_warp(size: Size) -> Found:
    """Measure MuJoCo Warp against MuJoCo C; see `_agreement`."""
    yield from _agreement("warp", size)


@functools.cache
def _reference(size: Size) -> tuple[world.Trial, np.ndarray, np.ndarray]:
    """Return scenes, each once for every grasp on it, with MuJoCo C's poses after pushes and what its grasps hold.

    So an engine makes all pushes in one batch, and all grasps in another of the same size.
    """
    native = engine("native", size)
    made = world.trial(jax.random.key(size.seed), native, size.agreeing, config=size.mixed())
    poses = np.asarray(primitives.push(native, made.items.scene, made.items.poses, made.pushes).poses)
    held = world.held_by(native, made)
    scenes_, grasps = held.shape[:2]
    rows = np.repeat(np.arange(scenes_), grasps)
    each = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, 1, *leaf.shape[2:]), made.grasps)
    repeated = world.Trial(structs.take(made.items, rows), structs.take(made.pushes, rows), each)
    return repeated, poses[rows], held.reshape(-1, 1, *held.shape[2:])


def _agreement(name: Any, size: Size) -> Found:
    """Measure how far an engine's pushes of 1 to 7 objects are from MuJoCo C's, and how many grasps end alike.

    Raises:
      NotMeasured: the engine is not installed.
      Wrong: they are too far, or too few.
    """
    if name.endswith("warp") and not installed("warp"):
        raise NotMeasured("NVIDIA Warp is not installed; install the extra `warp`")
    made, poses, held = _reference(size)
    tested = engine(name, size)
    make_ready(tested, made.items.scene, made.items.poses)
    found = world.agreement(name, tested, made, poses, held)
    shown = {"p50_mm": "5cm/p50_mm", "p90_mm": "5cm/p90_mm", "grasps_equal": "grasp", "grasps_held": "grasps_that_held"}
    figures = {key: found.get(f"agreement/{name}/{of}", np.nan) for key, of in shown.items()}
    yield from figures.items()
    yield "scenes", size.agreeing
    distance, equal = figures["p50_mm"], figures["grasps_equal"]
    if not (distance <= size.most_millimetres and equal >= LEAST_EQUAL):
        raise Wrong(
            f"{name} is {distance:.2f} mm (p50) from MuJoCo C and {equal:.1%} of its grasps end alike; "
            f"want at most {size.most_millimetres:g} mm and at least {LEAST_EQUAL:.0%}"
        )
    yield "", distance


def reproducible(size: Size) -> Found:
    """Measure the share of scenes that MJX, and with it the Warp kernel, simulate twice to the same bytes.

    Both runs are of the same batch on the same device.

    Raises:
      Wrong: not all of them.
    """
    yield "", _repeated("mjx", size)
    if installed("warp"):
        yield "mjx_warp", _repeated("mjx_warp", size)
    else:
        yield "mjx_warp", "not measured: NVIDIA Warp is not installed; install the extra `warp`"


def _repeated(name: EngineName, size: Size) -> float:
    """Return the share of scenes that an engine simulates twice to the same bytes; see `reproducible`."""
    tested, made = engine(name, size), _reference(size)[0]
    runs = []
    for _ in range(2):
        rollout = primitives.settle(tested, made.items.scene, _raised(made.items.poses), duration=REPEATED_SECONDS)
        runs.append(jax.tree.map(np.asarray, rollout))
    same = np.ones(len(made.items.fault), bool)
    for first, second in zip(*map(jax.tree.leaves, runs), strict=True):
        bits = [leaf.reshape(len(same), -1).view(np.uint8) for leaf in (first, second)]
        same &= (bits[0] == bits[1]).all(-1)
    if not same.all():
        raise Wrong(
            f"{name}: {int((~same).sum())} of {len(same)} scenes end otherwise when they are simulated again; want none"
        )
    return float(same.mean())


def _raised(poses: np.ndarray) -> np.ndarray:
    """Return poses `[B, N, 7]` a little above the table, from where objects fall."""
    there = np.array(poses)
    there[..., 2] += 0.02
    return there
