"""Fixtures of all tests: compiled functions and small data sets, made once per session."""

from __future__ import annotations

import gc
import os
import pathlib
from typing import Any

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # as `console` sets it for the commands: JAX reads it when it is imported
# compiling is much of the time of the tests, and takes less so; what XLA computes differs by rounding
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")
gc.set_threshold(200_000, 50, 1000)  # traced programs are millions of objects that stay

from jaxtyping import install_import_hook

install_import_hook("dipn_jax", "shape_checks.check")  # before anything of the library is imported

import jax
import numpy as np
import pytest
from dipn_jax.datagen.generate import Job, generate

from dipn_jax.commands import console
from dipn_jax.physics import make_engine
from dipn_jax.world import clutter, scenes

console.enable_compilation_cache()

SLOTS = 5


@pytest.fixture(scope="session")
def engine() -> Any:
    """Return the engine of MuJoCo C."""
    return make_engine("native")


@pytest.fixture(scope="session")
def settled(engine: Any) -> Any:
    """Return six scenes of five objects at rest, as NumPy arrays."""
    return clutter.settled_scenes(jax.random.key(7), engine, scenes.fixed_count(SLOTS), 6)


def _job(kind: str, episodes: int, actions: int) -> Job:
    return Job(
        kind=kind,
        scene=scenes.fixed_count(3, spread=0.2),
        episodes=episodes,
        seed=0,
        shard_size=16,
        actions=actions,
        engine="native",
        timestep=None,
    )


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> dict[str, pathlib.Path]:
    """Make a tiny data set of each kind."""
    root = tmp_path_factory.mktemp("data")
    for kind, episodes, actions in (("push", 24, 4), ("grasp", 24, 4), ("images", 4, 1)):
        generate(_job(kind, episodes, actions), root / kind)
    return {kind: root / kind for kind in ("push", "grasp", "images")}


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a seeded generator."""
    return np.random.default_rng(0)
