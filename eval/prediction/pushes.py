"""Executed pushes on held-out scenes, with which predictions are compared."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dipn_jax import batching, structs
from dipn_jax.engine import Engine
from dipn_jax.planning import candidates
from dipn_jax.sight import imagine, masks, render
from dipn_jax.structs import Fault, Observation, Push, Scene, SettledScene
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import clutter, primitives
from dipn_jax.world.scenes import SceneConfig, nominal

DISTANCES = (5, 10)
"""Centimetres at which errors are reported."""


@dataclasses.dataclass(frozen=True)
class Executed:
    """A batch of executed pushes whose simulation can be used; NumPy arrays."""

    items: SettledScene  # [B] before the pushes
    pushes: Push  # [B]
    truth: Float[np.ndarray, "B _ N 7"]  # poses before, and after each of DISTANCES
    rolled: Float[np.ndarray, "B K N 7"] | None  # poses after the same pushes with nominal masses and frictions

    def __len__(self) -> int:
        return len(self.pushes.angle)

    def seen(self) -> Observation:
        """Return what the camera sees before the pushes `[B]`, as NumPy arrays."""
        return jax.tree.map(np.asarray, render.observe(self.items.scene, self.items.poses))

    @functools.cached_property
    def labels_after(self) -> np.ndarray:
        """Return the true labels `[B, K, H, W]` after each distance."""
        each = [render.observe(self.items.scene, self.truth[:, 1 + k]).label for k in range(len(DISTANCES))]
        return np.stack([np.asarray(label) for label in each], 1)

    def film(self, seen: Observation, motions: np.ndarray, i: int) -> dict[str, np.ndarray]:
        """Return pictures of push `i`: before, predicted with `motions [B, K, N, 3]`, after the longest distance."""
        image, push = structs.take(seen, i), structs.take(self.pushes, i)
        centers, _ = masks.mask_centers(jnp.asarray(image.label), self.truth.shape[2])
        after = render.render(structs.take(self.items.scene, i), self.truth[i, -1])
        return {
            "before": np.asarray(image.color),
            "predicted": np.asarray(imagine.imagine(image, centers, motions[i, -1]).color),
            "after": np.asarray(after.color),
            "push": np.array([*np.asarray(push.start), push.angle, DISTANCES[-1] * 0.01], np.float32),
        }


def execute(key: jax.Array, engine: Engine, config: SceneConfig, count: int, *, physics: bool) -> Executed:
    """Execute a push on each of `count` settled scenes and return those that were feasible and went well."""
    drop, aim = jax.random.split(key)
    items = clutter.settled_scenes(drop, engine, config, count)
    aimed, feasible = _one_push(jax.random.split(aim, len(items.fault)), items.scene, items.poses)
    items, pushes = structs.take(items, np.asarray(feasible)), structs.take(aimed, np.asarray(feasible))
    if not np.asarray(feasible).any():
        return Executed(items, pushes, np.zeros((0,)), None)
    result = primitives.push(engine, items.scene, items.poses, pushes)
    good = (np.asarray(result.fault) & Fault.UNUSABLE) == 0
    rolled = None
    if physics:
        guessed = primitives.push(engine, nominal(items.scene), items.poses, pushes)
        rolled = np.asarray(guessed.poses)[good][:, list(DISTANCES)]
    truth = np.asarray(result.poses)[good][:, [0, *DISTANCES]]
    return Executed(structs.take(items, good), structs.take(pushes, good), truth, rolled)


def _one_push(keys: jax.Array, scene: Scene, poses: Any) -> tuple[Push, jax.Array]:
    return batching.in_batches(_push_each, keys, scene, poses)


@jax.jit
def _push_each(keys: jax.Array, scene: Scene, poses: jax.Array) -> tuple[Push, jax.Array]:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Push, jax.Array]:
        key, one_scene, one_poses = args
        seen = render.render(one_scene, one_poses)
        pushes, feasible = candidates.sample_pushes(key, seen, count=1, distance=PUSH_STEPS * 0.01)
        return jax.tree.map(lambda leaf: leaf[0], pushes), feasible[0]

    return jax.lax.map(one, (keys, jax.tree.map(jnp.asarray, scene), jnp.asarray(poses)))
