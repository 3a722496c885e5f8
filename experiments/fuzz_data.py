"""Small data sets of objects that do not move, for the fuzzing of what reads them."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from dipn_jax.storage import accounting, shards
from dipn_jax.storage.manifest import update_manifest
from dipn_jax.structs import Grasp, GraspEpisode, Push, PushEpisode, Scene, SettledScene
from dipn_jax.system import files

CONFIG = {"kind": "push", "episodes": 6, "shard_size": 2, "seed": 0, "distances": [0.1], "weights": ""}
"""The configuration of a data set."""


def episodes(kind: str, *, count: int = 2, slots: int = 3) -> Any:
    """Return episodes of a kind, of objects that do not move."""
    rng = np.random.default_rng(0)

    def numbers(*shape: int) -> np.ndarray:
        return rng.uniform(0.01, 0.1, (count, *shape)).astype(np.float32)

    scene = Scene(
        rng.integers(0, 5, (count, slots), np.int32),
        numbers(slots, 3),
        numbers(slots, 3),
        numbers(slots),
        numbers(slots),
    )
    poses, fault = numbers(slots, 7), np.zeros(count, np.int32)
    if kind == "images":
        return SettledScene(scene, poses, fault)
    if kind == "grasp":
        held = rng.random((count, slots)) < 0.5
        return GraspEpisode(scene, poses, poses, Grasp(numbers(2), numbers(), numbers()), held, np.any(held, -1), fault)
    return PushEpisode(scene, np.repeat(poses[:, None], 11, 1), poses, Push(numbers(2), numbers(), numbers()), fault)


def data_set(folder: pathlib.Path, *, kind: str = "push", number: int = 2) -> None:
    """Write a data set of `number` shards with two episodes each, of which one shard more was asked for."""
    folder.mkdir(parents=True, exist_ok=True)
    config = {**CONFIG, "kind": kind, "episodes": 2 * number + 2}
    for index in range(number):
        shards.write_shard(folder, index, episodes(kind), kind=kind, config=config, faults={"dropped_scenes": 1})
    files.write_json(folder / "config.json", config)
    accounting.save_command(folder, [kind, "--episodes", "6"], of=3)
    update_manifest(folder)
