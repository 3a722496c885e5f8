"""Seconds of first calls in a fresh process, with and without the programs that the last process compiled."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

from benchmarks.harness import Setting
from dipn_jax import batching
from dipn_jax.sight import render

OBJECTS = 7
"""Number of objects in a scene."""
BATCH = 4
"""Number of scenes."""


def first_calls() -> float:
    """Measure the seconds of the first call of everything that is compiled on the way to a push episode with MJX."""
    import jax
    import numpy as np

    from dipn_jax.commands import console
    from dipn_jax.physics import make_engine
    from dipn_jax.planning import candidates
    from dipn_jax.world import primitives, scenes

    console.enable_compilation_cache()
    engine = make_engine("mjx")
    jax.block_until_ready(jax.numpy.zeros(1) + 1)  # the device is up
    begun = time.perf_counter()
    draw = jax.jit(jax.vmap(lambda key: scenes.random_scene(key, config=scenes.fixed_count(OBJECTS))))
    scene, poses = draw(jax.random.split(jax.random.key(0), batching.BATCH))
    seen = render.observe(scene, poses)
    aim = jax.jit(jax.vmap(lambda key, one: candidates.sample_pushes(key, one, count=3, distance=0.1)))
    jax.block_until_ready(aim(jax.random.split(jax.random.key(1), batching.BATCH), seen))
    few = jax.tree.map(lambda leaf: np.asarray(leaf)[:BATCH], scene)
    primitives.settle(engine, few, np.asarray(poses)[:BATCH], duration=0.01)
    return time.perf_counter() - begun


def _fresh(cache: pathlib.Path) -> float:
    """Run `first_calls` in its own process that keeps compiled programs in `cache`."""
    root = str(pathlib.Path(__file__).parent.parent)
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "PYTHONPATH": path}
    command = [sys.executable, "-m", "benchmarks.compilation"]
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def warm_over_cold(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds with a warm cache over seconds with an empty one."""
    cold = warm = 0.0
    for _ in range(setting.pick(1, 3)):
        with tempfile.TemporaryDirectory() as name:
            cold += _fresh(pathlib.Path(name))
            warm += _fresh(pathlib.Path(name))
    yield "compile.warm_over_cold", warm / cold


if __name__ == "__main__":
    print(first_calls())
