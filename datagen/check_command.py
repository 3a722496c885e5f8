"""The command `dipn-datagen check-world`. Importing this imports no JAX."""

from __future__ import annotations

import pathlib
from typing import Annotated

import tyro


def check_world(
    out: pathlib.Path,
    engines: tuple[str, ...] = ("native_awake", "native_1ms", "native_3.3ms", "native_5ms", "mjx"),
    scenes_: Annotated[int, tyro.conf.arg(name="scenes")] = 32,
    few: int = 8,
    tries: int = 100,
    seed: int = 0,
    threads: int | None = None,
) -> None:
    """Measure whether the simulated world is right: drops, grasps, pushes, the camera, and how far the engines agree.

    About ten minutes on two cores; the results of the last run are in docs/world.md:
      dipn-datagen check-world --out results/world

    Args:
      out: folder for metrics.json and world.md; the same command continues where it stopped.
      engines: which of native_awake, native_1ms, native_3.3ms, native_5ms, mjx, mjx_warp and warp are held against
        native.
      scenes_: scenes with a push and a grasp each.
      few: number of scenes for MuJoCo Warp and of drops for MJX, the engines that are slow on a CPU (on a GPU: of
        drops for Warp, too).
      tries: grasps of every catalogue item.
      seed: random seed of everything.
      threads: threads of the native engine; one per core by default.
    """
    from . import check

    check.run(out, check.CheckConfig(engines, scenes=scenes_, few=few, tries=tries, seed=seed), threads=threads)
