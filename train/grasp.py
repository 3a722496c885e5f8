"""GN's two tasks: geometric labels of images (pre-training), and outcomes of executed grasps."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import geometry, losses, records, render, structs
from dipn_jax.networks import grasp
from dipn_jax.structs import Grasp, GraspEpisode, Scene, SettledScene
from dipn_jax.workspace import WORKSPACE
from train.split import split

PRETRAIN_VIEW = 192
"""Pixels of a pre-training view."""
WINDOWS = {"compact": 112, "paper": 320}
"""Pixels around an executed grasp: the compact network sees about 50 on each side, the published one everything."""
TABLE_WEIGHT = 0.05
"""Weight of a table pixel beside a foreground pixel: most of an image is table."""


def turned_view(scene: Scene, poses: jax.Array, center: jax.Array, angle: jax.Array, *, pixels: int) -> Any:
    """The observation of a view centred on `center [2]` (metres) with its columns along `angle []`."""
    shift = -geometry.rotate2d(center, -angle)
    return render.render(scene, geometry.transform_poses(poses, -angle, shift), pixels=pixels)


def _flips(key: jax.Array, images: jax.Array, *others: jax.Array) -> list[jax.Array]:
    """Each example mirrored along its rows and its columns, or not: a grasp's mirror images are grasps."""
    for axis, axis_key in zip((1, 2), jax.random.split(key), strict=True):
        flip = jax.random.bernoulli(axis_key, 0.5, (images.shape[0],))
        both = [images, *others]
        both = [jnp.where(flip.reshape(-1, *[1] * (m.ndim - 1)), jnp.flip(m, axis), m) for m in both]
        images, others = both[0], tuple(both[1:])
    return [images, *others]


class PretrainTask:
    """Every pixel of a randomly turned image against `grasp.geometric_labels`: no physics."""

    network = "grasp"

    def __init__(self, data: pathlib.Path, config: grasp.GraspConfig) -> None:
        scenes, self.fingerprint = records.load(data, kind="images")
        self.examples = len(scenes.fault)
        self.train_set, self.test_set = split(scenes, data)
        self.size = len(self.train_set.fault)
        self.network_config = config

    def fetch(self, index: np.ndarray) -> SettledScene:
        """See `loop.Task`."""
        return structs.take(self.train_set, index)

    def views(self, scenes: SettledScene, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Images `[B, V, V, 4]`, labels `[B, V, V]` and weights `[B, V, V]` of random views."""

        def one(scene: Scene, poses: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            angle_key, shift_key = jax.random.split(k)
            angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
            center = jax.random.uniform(shift_key, (2,), minval=-0.08, maxval=0.08)
            seen = turned_view(scene, poses, center, angle, pixels=PRETRAIN_VIEW)
            weight = jnp.where(seen.label >= 0, 1.0, TABLE_WEIGHT)
            return render.rgbd(seen), grasp.geometric_labels(seen.height), weight

        return jax.vmap(one)(scenes.scene, scenes.poses, jax.random.split(key, scenes.fault.shape[0]))

    def loss(self, model: nnx.Module, batch: SettledScene, key: jax.Array) -> jax.Array:
        """See `loop.Task`."""
        view_key, flip_key = jax.random.split(key)
        images, labels, weight = _flips(flip_key, *self.views(batch, view_key))
        return losses.score_loss(model(images), labels, weight)

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """See `loop.Task`: loss on views of held-out scenes."""
        graph, state = nnx.split(model)
        index = np.arange(min(16, len(self.test_set.fault)))
        loss = self._measure(graph, state, structs.take(self.test_set, index))
        return {"held_out_loss": float(loss)}

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _measure(self, graph: Any, state: Any, scenes: SettledScene) -> jax.Array:
        images, labels, weight = self.views(scenes, jax.random.key(0))
        return losses.score_loss(nnx.merge(graph, state)(images), labels, weight)


class GraspTask:
    """Outcomes of executed grasps: loss at the executed pixel only, so only a window around it is rendered."""

    network = "grasp"

    def __init__(self, data: pathlib.Path, config: grasp.GraspConfig) -> None:
        episodes, self.fingerprint = records.load(data, kind="grasp")
        self.examples = len(episodes.fault)
        self.train_set, self.test_set = split(episodes, data)
        self.window = WINDOWS[config.preset]
        self.size = len(self.train_set.fault)
        self.network_config = config

    def fetch(self, index: np.ndarray) -> GraspEpisode:
        """See `loop.Task`."""
        return structs.take(self.train_set, index)

    def windows(self, episodes: GraspEpisode, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Images `[B, W, W, 4]` and the executed pixel `[B, 2]` (row, col), near the middle.

        The pixel is shifted by 0 to 7 pixels, so that every phase of the network's strides is trained.
        """
        count = episodes.fault.shape[0]
        phase = jax.random.randint(key, (count, 2), -4, 4)

        def one(scene: Scene, poses: jax.Array, taken: Grasp, shift: jax.Array) -> jax.Array:
            offset = (shift[::-1] + 0.5) * WORKSPACE.pixel  # (row, col) -> (x, y)
            center = taken.center - geometry.rotate2d(offset, taken.angle)
            return render.rgbd(turned_view(scene, poses, center, taken.angle, pixels=self.window))

        images = jax.vmap(one)(episodes.scene, episodes.poses, episodes.grasp, phase)
        return images, self.window // 2 + phase

    def _logits(self, model: nnx.Module, images: jax.Array, pixel: jax.Array) -> jax.Array:
        logits = model(images)
        return logits[jnp.arange(len(images)), pixel[:, 0], pixel[:, 1]]

    def loss(self, model: nnx.Module, batch: GraspEpisode, key: jax.Array) -> jax.Array:
        """See `loop.Task`."""
        phase_key, flip_key = jax.random.split(key)
        images, pixel = self.windows(batch, phase_key)
        mask = jnp.zeros(images.shape[:3]).at[jnp.arange(len(images)), pixel[:, 0], pixel[:, 1]].set(1.0)
        images, mask = _flips(flip_key, images, mask)
        logits = (model(images) * mask).sum((1, 2))
        return losses.score_loss(logits, batch.success.astype(jnp.float32), jnp.ones(len(images)))

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """See `loop.Task`: loss and accuracy on held-out grasps."""
        graph, state = nnx.split(model)
        size, rows = 64, []
        for begin in range(0, len(self.test_set.fault), size):
            index = np.arange(begin, begin + size) % len(self.test_set.fault)
            weight = np.arange(begin, begin + size) < len(self.test_set.fault)
            rows.append([float(v) for v in self._measure(graph, state, structs.take(self.test_set, index), weight)])
        loss, correct, count = np.array(rows).sum(0)
        return {"held_out_loss": loss / count, "accuracy": correct / count}

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _measure(self, graph: Any, state: Any, episodes: GraspEpisode, weight: jax.Array) -> tuple[jax.Array, ...]:
        images, pixel = self.windows(episodes, jax.random.key(0))
        logits = self._logits(nnx.merge(graph, state), images, pixel)
        success = episodes.success
        loss = losses.score_loss(logits, success.astype(jnp.float32), weight.astype(jnp.float32)) * weight.sum()
        return loss, ((logits > 0) == success) @ weight.astype(jnp.float32), weight.sum()
