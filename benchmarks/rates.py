"""Episodes a second, absolute: for the documentation of one machine, not for comparing two."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from unittest import mock

import jax

from benchmarks.datagen_mjx import engine as mjx_engine
from benchmarks.datagen_native import ACTIONS
from benchmarks.harness import Setting, make_data, seconds
from datagen import generate
from dipn_jax import scenes
from dipn_jax.physics import EngineName

COUNTS = (1, 3, 7, 10, 20, 30)
MOST_ON_CPU = 10
"""Objects that XLA on a CPU can simulate in bearable time."""


def _engine_kept(engine: EngineName) -> contextlib.AbstractContextManager[object]:
    """Every data set makes its engine anew; within this, MJX stays the one that has its programs compiled.

    The native one is left alone: it remembers models, which a second run of the same job must not find.
    """
    if engine == "native":
        return contextlib.nullcontext()
    return mock.patch.object(generate, "make_engine", lambda *_, **__: mjx_engine())


def rate(engine: EngineName, kind: str, objects: int, episodes: int, seed: int) -> float:
    """Episodes on disk a second; what JAX compiles is not counted."""
    scene = scenes.parse_objects(str(objects))
    shard = -(-episodes // (4 if engine == "native" else 2))
    job = generate.Job(kind, scene, episodes, seed, shard, ACTIONS[kind], engine)
    with _engine_kept(engine):
        make_data(job)
        return episodes / seconds(lambda: make_data(job))


def rates(setting: Setting) -> Iterator[tuple[str, float]]:
    """`rates.ENGINE/KIND/OBJECTS` for both engines and kinds."""
    on_cpu = jax.default_backend() == "cpu"
    plan: list[tuple[EngineName, int, tuple[int, ...]]] = [("native", setting.pick(96, 960), COUNTS)]
    if on_cpu and setting.scale == "small":
        plan.append(("mjx", 6, tuple(n for n in COUNTS if n <= MOST_ON_CPU)))
    else:
        plan.append(("mjx", 24 if on_cpu else setting.pick(384, 3840), COUNTS))
    for engine, episodes, counts in plan:
        for kind in ("push", "grasp"):
            for objects in counts:
                value = rate(engine, kind, objects, max(episodes * 7 // max(objects, 7), 4), setting.seed)
                yield f"rates.{engine}/{kind}/{objects}", value
