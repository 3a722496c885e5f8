"""The stage of `on_gpu` that says where the time of a step goes: the device's kernels by their time."""

from __future__ import annotations

import pathlib
import tempfile
from typing import Any

import jax
import numpy as np

from benchmarks.gpu_engines import ACCELERATORS, engine, heaps_of, make_ready
from benchmarks.gpu_stage import Found, NotMeasured, Size
from dipn_jax.physics import CONTROL_PERIOD
from dipn_jax.world import primitives

SHOWN = 10
"""Kernels that are shown."""
DEVICE = "/device:"
"""What the name of an accelerator's plane in a profile begins with."""
LINES = ("Stream", "XLA Ops")
"""What the names of a plane's lines begin with on which kernels are: the first of these that there is; both say all."""
PERIODS = 3
"""Control periods that are profiled."""


def profile(size: Size) -> Found:
    """Measure milliseconds of kernels of a control period of each accelerator's engine, and list the largest.

    Raises:
      NotMeasured: no profile shows kernels of a device.
    """
    batch, seen = size.batches[0], False
    scene, poses = heaps_of(size, batch)
    for name in ACCELERATORS:
        try:
            made = engine(name, size)
            make_ready(made, scene, poses)
            times = kernels(_traced(made, scene, poses), plane=DEVICE)
        except NotMeasured as reason:
            yield name, f"not measured: {reason}"
            continue
        total = sum(taken for _, taken in times.values())
        seen = True
        yield f"{name}_milliseconds", total / PERIODS
        yield f"{name}_launches", sum(count for count, _ in times.values()) / PERIODS
        if name == "mjx":
            yield "", total / PERIODS
        for number, text in enumerate(largest(times), 1):
            yield f"{name}/{number:02}", text
    if not seen:
        raise NotMeasured("no profile shows kernels of a device")


def _traced(engine: Any, scene: Any, poses: np.ndarray) -> jax.profiler.ProfileData:
    """Return the profile of some control periods of an engine."""
    still, end = primitives.parked_trajectory(len(poses), 1.0), np.array([PERIODS * CONTROL_PERIOD])
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0
    with tempfile.TemporaryDirectory() as name:
        with jax.profiler.trace(name, profiler_options=options):
            engine.simulate(scene, poses, still, end)
        found = next(pathlib.Path(name).rglob("*.xplane.pb"), None)
        if found is None:
            raise NotMeasured("the profiler wrote no profile")
        return jax.profiler.ProfileData.from_file(str(found))


def kernels(data: Any, *, plane: str) -> dict[str, tuple[int, float]]:
    """Return how often each kernel ran and the milliseconds that it took in all.

    Both are read from the lines of the first name in `LINES` that has any event.

    Args:
      data: a `jax.profiler.ProfileData`.
      plane: what the names of the planes begin with that are looked at.

    Raises:
      NotMeasured: there are none.
    """
    rows = [row for each in data.planes if each.name.startswith(plane) for row in each.lines]
    for begin in LINES:
        found: dict[str, tuple[int, float]] = {}
        for event in (event for row in rows if (row.name or "").startswith(begin) for event in row.events):
            count, taken = found.get(event.name, (0, 0.0))
            found[event.name] = count + 1, taken + event.duration_ns / 1e6
        if found:
            return found
    there = ", ".join(each.name for each in data.planes)
    raise NotMeasured(f"no kernels of a device in the profile, only of {there}"[:200])


def largest(times: dict[str, tuple[int, float]]) -> list[str]:
    """Return a line each for the kernels that take most of the time: share, milliseconds, runs and name."""
    total = sum(taken for _, taken in times.values()) or 1.0
    ordered = sorted(times.items(), key=lambda item: -item[1][1])[:SHOWN]
    return [f"{taken / total:.1%}, {taken:.3f} ms, {count} times: {name[:120]}" for name, (count, taken) in ordered]
