"""Drops of the native engine against drops whose every step is accurate: time, and how objects rest."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from unittest import mock

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from benchmarks.harness import Setting, alternate
from dipn_jax import geometry, structs
from dipn_jax.engine import Engine
from dipn_jax.physics import make_engine, native
from dipn_jax.structs import Array, Rollout, Scene
from dipn_jax.world import primitives, scenes

COUNTS = (1, 7, 30)
"""Numbers of objects."""
COARSE = dataclasses.replace(native.DEFAULTS, falling_timestep=0.005)
"""Settings with steps that are too large while objects fall."""
FACES = 6
"""Directions of an object's own axes, of which one points down."""


class _AllSteps(native._Worlds):
    """Worlds that compute every step, also of a scene that rests."""

    def advance(self) -> tuple[np.ndarray, np.ndarray]:
        """See `hosted.Worlds`."""
        self._still = np.zeros_like(self._still)
        return super().advance()


def dropped(objects: int, count: int, seed: int) -> tuple[Scene, np.ndarray]:
    """Return `count` random scenes and the poses `[count, N, 7]` in mid-air of their objects."""
    draw = jax.jit(jax.vmap(functools.partial(scenes.random_scene, config=scenes.parse_objects(str(objects)))))
    scene, poses = jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(seed), count)))
    return scene, poses


def settle_in_batches(engine: Engine, scene: Scene, poses: Float[np.ndarray, "B N 7"]) -> Rollout:
    """Return the rollouts of all drops, made in batches of the engine's size."""
    parts = []
    for first in range(0, len(poses), engine.batch):
        some = slice(first, first + engine.batch)
        parts.append(primitives.settle(engine, structs.take(scene, some), poses[some], fence=primitives.FENCE_TIME))
    return structs.concatenate(parts)


def settle_accurately(engine: Engine, scene: Scene, poses: Float[np.ndarray, "B N 7"]) -> Rollout:
    """Return what `settle_in_batches` returns, with every step of every scene computed."""
    with mock.patch.object(native, "_Worlds", _AllSteps):
        return settle_in_batches(engine, scene, poses)


def faces_down(poses: Float[np.ndarray, "B N 7"]) -> Int[np.ndarray, "B N"]:
    """Return which of an object's own directions (x, y, z, then their opposites) points down the most."""
    up = np.asarray(geometry.quat_to_matrix(poses[..., 3:]))[..., 2, :]
    return np.concatenate([-up, up], -1).argmax(-1)


def alike(drops: tuple[Rollout, Rollout], shapes: tuple[Int[Array, "B N"], Int[Array, "B N"]]) -> dict[str, float]:
    """Return p-values of tests that two sets of drops come to rest in the same way.

    Kolmogorov and Smirnov's test of two samples for the mean height and the mean distance from the middle of each
    scene's objects; the chi-squared test for which side of an object of each class is down.
    """
    kept = [np.asarray(one.fault) == 0 for one in drops]
    poses = [np.asarray(one.poses)[good, -1] for one, good in zip(drops, kept, strict=True)]
    heights = [at[..., 2].mean(-1) for at in poses]
    spreads = [np.linalg.norm(at[..., :2], axis=-1).mean(-1) for at in poses]
    kinds = [
        np.asarray(shape)[good] * FACES + faces_down(at) for shape, at, good in zip(shapes, poses, kept, strict=True)
    ]
    counted = np.stack([np.bincount(kind.ravel(), minlength=int(max(map(np.max, kinds))) + 1) for kind in kinds])
    often = counted[:, counted.sum(0) >= 10]  # as the chi-squared test wants it
    return {
        "height": float(stats.ks_2samp(*heights).pvalue),
        "spread": float(stats.ks_2samp(*spreads).pvalue),
        "faces": float(stats.chi2_contingency(often).pvalue),
    }


def cheaper(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure how much faster drops are, and p-values that objects rest as with accurate steps."""
    for objects in COUNTS:
        ours, theirs = make_engine("native"), make_engine("native", timestep=native.DEFAULTS.timestep)
        scene, poses = dropped(objects, 64, setting.seed)
        ours_again = functools.partial(settle_in_batches, ours, scene, poses)
        theirs_again = functools.partial(settle_accurately, theirs, scene, poses)
        ours_again(), theirs_again()  # compile the models, which both keep
        mine, other = alternate(ours_again, theirs_again, repeats=setting.pick(1, 5))
        yield f"drops.cheaper/{objects}", other / mine
    for objects, count in ((7, setting.pick(64, 1536)), (30, setting.pick(16, 384))):
        scene, poses = dropped(objects, count, setting.seed + 1)
        other_scene, other_poses = dropped(objects, count, setting.seed + 2)
        first, second = settle_in_batches(ours, scene, poses), settle_accurately(theirs, other_scene, other_poses)
        coarse = settle_in_batches(native.NativeEngine(COARSE), scene, poses)
        for steps, drops in (("", first), ("_5ms", coarse)):
            for name, value in alike((drops, second), (scene.shape, other_scene.shape)).items():
                yield f"drops.cheaper/p_{name}{steps}/{objects}", value
        for name, rollout in (("kept", first), ("kept_accurate", second)):
            yield f"drops.cheaper/{name}/{objects}", float((np.asarray(rollout.fault) == 0).mean())
