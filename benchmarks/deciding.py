"""Seconds per decision, whether the fast path decides as the plain one does, and what lockstep gains."""

from __future__ import annotations

import functools
import pathlib
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from dipn_jax.eval.clearing import instances, lockstep, on_tables
from flax import nnx

from benchmarks.harness import Setting, alternate, quiet, seconds
from dipn_jax import geometry, structs
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import VIEW_PIXELS, GraspConfig
from dipn_jax.physics import make_engine
from dipn_jax.planning import candidates, methods, planner, predictors, scorers
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.sight import imagine, masks, render
from dipn_jax.storage import checkpoint, resume
from dipn_jax.structs import Decision, Observation, Push
from dipn_jax.workspace import grasp_angles
from dipn_jax.world import cases, clutter, scenes

BUILTIN = pathlib.Path("builtin")
COUNTS = (16, 64, 256)
"""Numbers of candidates."""
ALWAYS_CONSIDER_PUSHES = planner.Rule(grasp_above=1.0)
"""A rule that considers pushes however good the best grasp is: a decision at its full cost."""
KINDS = (("3:8", 1.0), ("1:10", 0.0), ("20", 0.0), ("30", 0.0))
"""Numbers of objects, and shares of packed scenes, on which both paths decide."""


def _networks(preset: str) -> tuple[Any, Any]:
    """Return DIPN and GN: the trained compact networks, or published ones with random weights, which are as fast."""
    if preset == "compact":
        return checkpoint.load_network(BUILTIN, network="dipn"), checkpoint.load_network(BUILTIN, network="grasp")
    dipn = checkpoint.build("dipn", DipnConfig(preset="paper"))
    gn = checkpoint.build("grasp", GraspConfig(preset="paper"))
    dipn.eval()
    gn.eval()
    return dipn, gn


def _seen(objects: str, count: int, seed: int, *, packed: float = 0.0) -> Observation:
    """Return observations `[count]` of random scenes."""
    config = scenes.parse_objects(objects, ranges=scenes.Ranges(packed=packed))
    items = clutter.settled_scenes(jax.random.key(seed), make_engine("native"), config, count)
    observations: Observation = jax.device_get(render.observe(items.scene, items.poses))
    return observations


def _decider(preset: str, count: int, *, fast: bool) -> Callable[[Observation, int], Decision]:
    dipn, gn = _networks(preset)
    predictor, scorer = predictors.dipn_predictor(dipn), scorers.aided_scorer(gn)
    summarize = scorers.grasp_summary(gn) if fast else planner.summarize_whole(scorers.unaided_scorer(gn))

    def decide(seen: Observation, key: int) -> Decision:
        random = jax.random.key(key)
        return jax.device_get(
            planner.decide(
                random, seen, predictor, scorer, count=count, rule=ALWAYS_CONSIDER_PUSHES, summarize=summarize
            )
        )

    return decide


def speed(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of a decision on a scene of ten objects, all of whose candidates are considered."""
    seen = _seen("10", 4, setting.seed)
    tables = [structs.take(seen, i) for i in range(4)]
    for count in COUNTS:
        decide = _decider("compact", count, fast=True)
        decide(tables[0], 0)
        taken = seconds(functools.partial(_all, decide, tables)) / len(tables)
        yield f"decide.speed/compact_{count}", taken
    few = setting.pick(2, 4)
    each = _paper_one_by_one(tables[0], few)
    whole = _paper_whole(tables[0], few)
    for count in COUNTS:
        decide = _decider("compact", count, fast=True)
        yield f"decide.speed/paper_{count}", whole * _images(decide, tables)
    decide = _decider("compact", 64, fast=True)
    images = _images(decide, tables)
    ours = seconds(lambda: _all(decide, tables)) / len(tables)
    yield "decide.speed/images_64", images
    yield "decide.speed/paper_one_by_one_64", each * images
    yield "decide.speed", each * images / ours


def _images(decide: Callable[[Observation, int], Decision], tables: list[Observation]) -> float:
    """Return how many images a decision compares: the present one, and one for each push that is not dropped."""
    found = [decide(table, 0).candidates for table in tables]
    return float(np.mean([1 + each.feasible.sum() for each in found if each is not None]))


def _all(decide: Callable[[Observation, int], Decision], tables: list[Observation]) -> None:
    for table in tables:
        decide(table, 0)


def _imagined(seen: Observation, count: int, predictor: Any) -> Callable[[int], jax.Array]:
    """Return the image after candidate `i`, each predicted by itself."""
    seen = jax.tree.map(jnp.asarray, seen)
    pushes, _ = candidates.sample_pushes(jax.random.key(0), seen, count=count, distance=0.1)

    @jax.jit
    def one(push: Push) -> jax.Array:
        motion = predictor(seen, jax.tree.map(lambda leaf: leaf[None], push))[0]
        centers, _ = masks.mask_centers(seen.label, seen.slots)
        return render.rgbd(imagine.imagine(seen, centers, motion))

    return lambda i: one(structs.take(pushes, i))


def _paper_one_by_one(seen: Observation, count: int) -> float:
    """Measure seconds per image of the published networks, one candidate and one rotation at a time."""
    dipn, gn = _networks("paper")
    image_after = _imagined(seen, count, predictors.dipn_predictor(dipn))
    graph, state = nnx.split(gn)

    @jax.jit
    def rotation(image: jax.Array, angle: jax.Array) -> jax.Array:
        table = jnp.array([*render.TABLE_COLOR, 0.0])
        view = geometry.rotate_map(image - table, angle, VIEW_PIXELS) + table
        score = nnx.sigmoid(nnx.merge(graph, state)(view[None]))[0]
        return geometry.unrotate_map(score, angle, image.shape[0]).mean()

    def work() -> None:
        for i in range(count):
            image = image_after(i)
            np.mean([float(rotation(image, angle)) for angle in grasp_angles()])

    work()
    return seconds(work) / count


def _paper_whole(seen: Observation, count: int) -> float:
    """Measure seconds per image of the published networks, all rotations of it in one call."""
    dipn, gn = _networks("paper")
    image_after = _imagined(seen, count, predictors.dipn_predictor(dipn))
    mean = jax.jit(lambda image: scorers.unaided_scorer(gn)(image[None]).mean())

    def work() -> None:
        for i in range(count):
            mean(image_after(i)).block_until_ready()

    work()
    return seconds(work) / count


def fast_path(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure how often the fast path decides as the plain one does, and how much faster it is, with 64 candidates."""
    each, same, pushed = setting.pick(10, 125), [], []
    for objects, packed in KINDS:
        seen = _seen(objects, each, setting.seed, packed=packed)
        plain, fast = (_decider("compact", 64, fast=quick) for quick in (False, True))
        tables = [structs.take(seen, i) for i in range(each)]
        pairs = [(plain(table, i), fast(table, i)) for i, table in enumerate(tables)]
        same += [_same(*pair) for pair in pairs]
        pushed += [bool(slow.is_push) for slow, _ in pairs]
        sides = [functools.partial(_all, decide, tables[:4]) for decide in (plain, fast)]
        slow, quick = alternate(*sides, repeats=3)
        name = f"packed_{objects}" if packed else f"random_{objects}"
        yield f"decide.fast_path/times/{name.replace(':', '_')}", slow / quick
    yield "decide.fast_path/scenes", len(same)
    yield "decide.fast_path/pushes", sum(pushed)
    yield "decide.fast_path/same_of_pushes", float(np.mean(np.array(same)[pushed])) if any(pushed) else 1.0
    yield "decide.fast_path", float(np.mean(same))


def _same(plain: Decision, fast: Decision) -> bool:
    """Return whether two decisions are the same: the same grasp, or the same push."""
    return bool(plain.is_push == fast.is_push and (not plain.is_push or plain.best == fast.best))


def in_lockstep(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure episodes of the hard cases per minute, all side by side, over one after the other."""
    engine, path = make_engine("native"), cases.hard_cases_path()
    slots, repeats = int(cases.load_cases(path)[1].shape.shape[1]), setting.pick(1, 3)
    networks = methods.Networks(BUILTIN, BUILTIN)
    (decide,) = on_tables.load("dipn+gn", networks, engine, [PolicyConfig()])

    def tables() -> list[instances.Instance]:
        return instances.case_instances(engine, path, None, slots=slots, repeats=repeats, seed=setting.seed)

    def clear(some: list[instances.Instance]) -> None:
        with tempfile.TemporaryDirectory() as name, quiet():
            lockstep.clear(some, engine, decide, resume.Partial(pathlib.Path(name), {}), seed=setting.seed)

    def together() -> None:
        clear(tables())

    def apart() -> None:
        for table in tables():
            clear([table])

    together()
    side_by_side, one_by_one = alternate(together, apart, repeats=setting.pick(1, 3))
    yield "decide.lockstep", one_by_one / side_by_side
    yield "decide.lockstep/episodes_per_minute", 60 * len(tables()) / side_by_side
