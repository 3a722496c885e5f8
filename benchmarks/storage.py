"""The size of an episode on disk against that of the images that it stands for."""

from __future__ import annotations

import pathlib
import tempfile
from collections.abc import Iterator

import cv2
import jax
import numpy as np
from dipn_jax.datagen.generate import Job, generate

from benchmarks.harness import Setting, quiet
from dipn_jax import structs
from dipn_jax.sight import render
from dipn_jax.storage import shards
from dipn_jax.structs import Observation, PushEpisode
from dipn_jax.world import scenes

OBJECTS = 10
"""Number of objects in a scene."""
DEPTH_UNIT = 1e-4
"""Metres per step of a 16-bit depth image."""


def png_bytes(seen: Observation) -> int:
    """Return the bytes of colour and depth of observations `[B]` as PNGs."""
    total = 0
    for color, height in zip(np.asarray(seen.color), np.asarray(seen.height), strict=True):
        eight = np.rint(color[..., ::-1] * 255).astype(np.uint8)
        sixteen = np.rint(np.maximum(height, 0.0) / DEPTH_UNIT).astype(np.uint16)
        for image in (eight, sixteen):
            fine, code = cv2.imencode(".png", image)
            assert fine
            total += code.size
    return total


def image_bytes(episodes: PushEpisode, count: int) -> float:
    """Return the mean bytes of the frames of an episode, from `count` of them."""
    frames = np.asarray(episodes.poses).shape[1]
    total = 0
    for i in np.linspace(0, len(episodes.fault) - 1, count).astype(int):
        poses = np.asarray(episodes.poses)[i]
        repeated = structs.take(episodes.scene, np.full(frames, i))
        total += png_bytes(render.observe(repeated, poses))
    return total / count


def vs_images(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure bytes of a push episode, its share of the metadata included, over those of its images."""
    episodes = setting.pick(200, 1000)
    job = Job(
        kind="push",
        scene=scenes.fixed_count(OBJECTS),
        episodes=episodes,
        seed=setting.seed,
        shard_size=min(episodes, 500),
        actions=3,
        engine="native",
    )
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name) / "data"
        with quiet():
            generate(job, folder)
        whole = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        made = shards.read_shard(shards.shard_path(folder, 0), kind="push")
    made = jax.tree.map(np.asarray, made)
    yield "storage.vs_images", whole / episodes / image_bytes(made, setting.pick(20, 100))
