"""Episodes a second, absolute: for the documentation of one machine, not for comparing two."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator
from unittest import mock

import jax

from benchmarks.datagen_mjx import engine as mjx_engine
from benchmarks.datagen_native import ACTIONS
from benchmarks.harness import Setting, Skipped, make_data, seconds
from datagen import generate
from dipn_jax import scenes
from dipn_jax.physics import EngineName, make_engine

COUNTS = (1, 3, 7, 10, 20, 30)
FEW_ON_CPU = 4
"""Episodes that XLA and Warp make of each kind on a CPU at small scale: their rate is below one a second."""


def _engine_kept(engine: EngineName) -> contextlib.AbstractContextManager[object]:
    """Every data set makes its engine anew; within this, one stays that has its programs compiled.

    The native one is left alone: it remembers models, which a second run of the same job must not find.
    """
    if engine == "native":
        return contextlib.nullcontext()
    made = mjx_engine() if engine == "mjx" else make_engine(engine)
    return mock.patch.object(generate, "make_engine", lambda *_, **__: made)


def rate(engine: EngineName, kind: str, objects: int, episodes: int, seed: int) -> float:
    """Episodes on disk a second; what JAX compiles is not counted."""
    scene = scenes.parse_objects(str(objects))
    shard = -(-episodes // (4 if engine == "native" else 2))
    job = generate.Job(kind, scene, episodes, seed, shard, ACTIONS[kind], engine)
    with _engine_kept(engine):
        make_data(job)
        return episodes / seconds(lambda: make_data(job))


def _rates(engine: EngineName, setting: Setting, episodes: int) -> Iterator[tuple[str, float]]:
    """`rates.ENGINE/KIND/OBJECTS`; fewer episodes of many objects."""
    for kind in ("push", "grasp"):
        for objects in COUNTS:
            value = rate(engine, kind, objects, max(episodes * 7 // max(objects, 7), 4), setting.seed)
            yield f"rates.{engine}/{kind}/{objects}", value


def native(setting: Setting) -> Iterator[tuple[str, float]]:
    """MuJoCo C on all cores."""
    return _rates("native", setting, setting.pick(96, 960))


def mjx(setting: Setting) -> Iterator[tuple[str, float]]:
    """MJX, XLA."""
    few = setting.pick(FEW_ON_CPU, 24)
    return _rates("mjx", setting, few if jax.default_backend() == "cpu" else setting.pick(384, 3840))


def warp(setting: Setting) -> Iterator[tuple[str, float]]:
    """MuJoCo Warp."""
    if importlib.util.find_spec("warp") is None:
        raise Skipped("MuJoCo Warp is not installed; run pip install 'dipn-jax[warp]'")
    few = setting.pick(FEW_ON_CPU, 24)
    return _rates("warp", setting, few if jax.default_backend() == "cpu" else setting.pick(384, 3840))
