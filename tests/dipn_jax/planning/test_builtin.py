"""The networks that come with the package."""

from __future__ import annotations

import pathlib
from typing import Any

import jax
import numpy as np
import pytest

from dipn_jax import geometry, structs
from dipn_jax.planning import candidates, predictors, scorers
from dipn_jax.sight import masks, render
from dipn_jax.storage import checkpoint
from dipn_jax.world import primitives


@pytest.mark.slow
def test_the_builtin_push_network_predicts_pushes_well(settled: Any, engine: Any) -> None:
    """On three scenes of five objects its error is far below that of no motion."""
    scene, poses = structs.take(settled.scene, slice(0, 3)), settled.poses[:3]
    seen = render.observe(scene, poses)
    sample = jax.vmap(lambda key, one: candidates.sample_pushes(key, one, count=1, distance=0.1))
    pushes, feasible = sample(jax.random.split(jax.random.key(0), 3), seen)
    pushes = jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], pushes)
    assert feasible.all()
    network: Any = checkpoint.load_network(pathlib.Path("builtin"), network="dipn")
    distances = np.tile(np.array([0.05, 0.1], np.float32), (3, 1))
    told = predictors.dipn_motions(network, seen, pushes, distances)
    rolled = np.asarray(primitives.push(engine, scene, poses, pushes).poses)
    centers = jax.vmap(lambda label: masks.mask_centers(label, 5)[0])(seen.label)
    true = geometry.planar_motion(rolled[:, :1], rolled[:, [5, 10]], centers[:, None])
    moved = np.linalg.norm(true[..., :2], axis=-1) > 0.01
    error = np.linalg.norm((told - true)[..., :2], axis=-1)
    assert moved.sum() >= 4
    assert error[moved].mean() < 0.25 * np.linalg.norm(true[..., :2], axis=-1)[moved].mean()


def test_the_builtin_grasp_network_grasps(settled: Any, engine: Any) -> None:
    scorer = scorers.load_scorer("builtin")
    seen = jax.tree.map(np.asarray, render.observe(settled.scene, settled.poses))
    images = jax.vmap(render.rgbd)(seen)
    scores = jax.jit(scorer)(images)
    taken = [candidates.grasp_at(candidates.best_grasp(scores[i])[0], seen.height[i]) for i in range(len(images))]
    _, outcome = primitives.grasp(engine, settled.scene, settled.poses, structs.stack(taken))
    assert np.asarray(outcome.success).sum() >= len(images) - 1


@pytest.mark.parametrize("network", ["dipn", "grasp"])
def test_a_builtin_network_is_small_and_names_no_folder_of_the_machine_that_made_it(network: str) -> None:
    folder = checkpoint.find(pathlib.Path("builtin"), network=network)
    stored = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in stored) < 3e6
    assert not [path for path in stored if path.suffix == ".txt" and b" /" in path.read_bytes()]
