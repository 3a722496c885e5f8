"""GN: the speed of training and scoring against PyTorch."""

from __future__ import annotations

import functools
import importlib.util
import pathlib
import tempfile
from collections.abc import Iterator

import jax
import numpy as np

from benchmarks.harness import Setting, Skipped, alternate
from benchmarks.worker import Worker, versus
from dipn_jax.networks.grasp import VIEW_PIXELS
from dipn_jax.physics import make_engine
from dipn_jax.sight import render
from dipn_jax.world import clutter, scenes

BATCHES = {"compact": (32, 112), "paper": (2, VIEW_PIXELS)}
"""Examples per training step, and pixels a side of each."""
OBJECTS = 10
"""Number of objects in a scene."""


def _need_torch() -> None:
    if importlib.util.find_spec("torch") is None:
        raise Skipped("PyTorch is not installed; run pip install torch (the extra `bench`)")


def _image(seed: int) -> np.ndarray:
    """Return what the camera sees of a scene of ten objects `[224, 224, 4]`."""
    items = clutter.settled_scenes(jax.random.key(seed), make_engine("native"), scenes.fixed_count(OBJECTS), 1)
    seen = jax.tree.map(lambda leaf: leaf[0], render.observe(items.scene, items.poses))
    return np.asarray(render.rgbd(seen))


def compact_vs_torch_paper(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of the 16 rotations of one image: `compact` over the published network in PyTorch."""
    yield from _scoring(setting, "compact", 10)


def paper_vs_torch_paper(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of the 16 rotations of one image: the published network over the same in PyTorch."""
    yield from _scoring(setting, "paper", 1)


def _scoring(setting: Setting, preset: str, count: int) -> Iterator[tuple[str, float]]:
    _need_torch()
    with tempfile.TemporaryDirectory() as name:
        file = pathlib.Path(name) / "image.npz"
        np.savez(file, allow_pickle=False, image=_image(setting.seed))
        ours = Worker("grasp_worker", "jax", preset, "score", file)
        other = Worker("grasp_worker", "torch", "paper", "score", file)
        sides = [functools.partial(ours.steps, count), functools.partial(other.steps, 1)]
        taken, theirs = alternate(*sides, repeats=setting.pick(3, 9))
        mine, others = ours.close()[0], other.close()[0]
    if preset == "paper" and mine != others:
        raise RuntimeError(f"{mine} parameters against {others} in PyTorch: not the same network")
    figure = f"bench_grasp.{preset}_vs_torch_paper"
    yield figure, taken / count / theirs
    yield f"{figure}/milliseconds", 1000 * taken / count
    yield f"{figure}/torch_milliseconds", 1000 * theirs


def training_examples(preset: str, batch: int, seed: int) -> dict[str, np.ndarray]:
    """Return the images `[B, W, W, 4]`, pixels `[B, 2]` and outcomes `[B]` of a training step, by their names."""
    wide, side = np.pad(_image(seed), [(48, 48), (48, 48), (0, 0)]), BATCHES[preset][1]
    begin = (wide.shape[0] - side) // 2
    images = np.repeat(wide[None, begin : begin + side, begin : begin + side], batch, 0)
    success = (np.arange(batch) % 2).astype(np.float32)
    return {"images": images, "pixel": np.full((batch, 2), side // 2), "success": success}


def vs_torch(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure samples per second of a training step over those in PyTorch, and our peak memory over PyTorch's."""
    _need_torch()
    for preset, (batch, _) in BATCHES.items():
        with tempfile.TemporaryDirectory() as name:
            file = pathlib.Path(name) / "examples.npz"
            np.savez(file, allow_pickle=False, **training_examples(preset, batch, setting.seed))
            count = 1 if preset == "paper" else setting.pick(5, 20)
            figure, arguments = f"bench_grasp.vs_torch/{preset}", (preset, "train", file)
            yield from versus(figure, "grasp_worker", arguments, batch=batch, count=count, repeats=setting.pick(3, 9))
