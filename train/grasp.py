"""GN's two tasks: geometric labels of images (pre-training), and outcomes of executed grasps."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float, Int

from dipn_jax import batching, geometry
from dipn_jax.networks import grasp, losses
from dipn_jax.sight import fingers, render
from dipn_jax.storage import serialization
from dipn_jax.storage.on_demand import Episodes
from dipn_jax.storage.space import Space
from dipn_jax.structs import Array, GraspEpisode, Observation, Pytree, Scene, SettledScene
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import shapes

from .example_store import ExampleStore
from .split import Folders, load_split

PRETRAIN_VIEW = 192
"""Pixels of a pre-training view."""
WINDOW_PIXELS = {"compact": 112, "paper": 320}
"""Pixels of a window around an executed grasp: compact networks see about 50 on each side, published ones all."""
SHIFT_PIXELS = 4
"""Pixels by which a grasp is moved in its window at most, so that every phase of the network's strides is trained."""
TABLE_WEIGHT = 0.05
"""Weight of a table pixel beside a foreground pixel: most of an image is table."""
GRASP_MIRRORS = (1, 2)
"""Axes `[B, row, col]` along which images of grasps may be mirrored: mirror images of grasps are grasps."""
PUSH_MIRRORS = (1,)
"""Axes along which images of pushes may be mirrored: only rows, because a push goes along the columns."""


def turned_view(scene: Scene, poses: Array, center: Array, angle: Array, *, pixels: int) -> Observation:
    """Return the observation of a view centred on `center [2]` (metres) with its columns along `angle []`."""
    shift = -geometry.rotate2d(center, -angle)
    return render.render(scene, geometry.transform_poses(poses, -angle, shift), pixels=pixels)


def _flips(key: jax.Array, axes: tuple[int, ...], images: jax.Array, *others: jax.Array) -> list[jax.Array]:
    """Mirror examples at random along each of `axes`."""
    for axis, axis_key in zip(axes, jax.random.split(key, len(axes)), strict=True):
        flip = jax.random.bernoulli(axis_key, 0.5, (images.shape[0],))
        both = [images, *others]
        both = [jnp.where(flip.reshape(-1, *[1] * (m.ndim - 1)), jnp.flip(m, axis), m) for m in both]
        images, others = both[0], tuple(both[1:])
    return [images, *others]


class PretrainTask:
    """Task of learning `fingers.geometric_labels` of every pixel of randomly turned images; it takes no physics."""

    network = "grasp"

    def __init__(self, data: Folders, config: grasp.GraspConfig, *, space: Space | None = None) -> None:
        """Check data sets; an episode is read when it is first fetched, with the others of its shard.

        Args:
          data: folders of images; the last tenth of each is held out.
          config: architecture.
          space: where the scenes are kept; None: in memory.
        """
        split = load_split(data, kind="images", space=space)
        self.train_set, self.test_set, self.fingerprint = split.learnt, split.held_out, split.fingerprint
        self.size, self.parts = len(self.train_set), split.parts
        self.examples = self.size + len(self.test_set)
        self.network_config = config

    def fetch(self, index: np.ndarray) -> SettledScene:
        """See `loop.Task`."""
        taken: SettledScene = self.train_set.take(index)
        return taken

    def views(self, settled: SettledScene, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return images `[B, V, V, 4]`, labels `[B, V, V]` and weights `[B, V, V]` of random views."""

        def one(args: tuple[Scene, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
            scene, poses, k = args
            angle_key, shift_key = jax.random.split(k)
            angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
            center = jax.random.uniform(shift_key, (2,), minval=-0.08, maxval=0.08)
            seen = turned_view(scene, poses, center, angle, pixels=PRETRAIN_VIEW)
            weight = jnp.where(seen.label >= 0, 1.0, TABLE_WEIGHT)
            return render.rgbd(seen), fingers.geometric_labels(jnp.asarray(seen.height)), weight

        return jax.lax.map(one, (settled.scene, settled.poses, jax.random.split(key, settled.fault.shape[0])))

    def loss(self, model: nnx.Module, batch: SettledScene, key: jax.Array) -> jax.Array:
        """See `loop.Task`."""
        view_key, flip_key = jax.random.split(key)
        images, labels, weight = _flips(flip_key, GRASP_MIRRORS, *self.views(batch, view_key))
        return losses.score_loss(model(images), labels, weight)

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """See `loop.Task`: loss on views of held-out scenes."""
        graph, state = nnx.split(model)
        index = np.arange(min(16, len(self.test_set)))
        loss = self._measure(graph, state, self.test_set.take(index))
        return {"held_out_loss": float(loss)}

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _measure(self, graph: Any, state: Any, settled: SettledScene) -> jax.Array:
        images, labels, weight = self.views(settled, jax.random.key(0))
        return losses.score_loss(nnx.merge(graph, state)(images), labels, weight)


@serialization.register
@flax.struct.dataclass
class Window(Pytree):
    """One executed action as an example; the closing axis of a grasp, or a push, lies along the columns."""

    height: Float[Array, "*b W W"]  # float16, metres; the action is at the centre of pixel (W / 2, W / 2)
    label: Int[Array, "*b W W"]  # int8: object slot, ABSENT on the table
    color: Float[Array, "*b N 3"]  # in [0, 1], of the objects
    target: Float[Array, "*b"]  # float32: 1 if a grasp held, 0 if not; or another measure of the result


@functools.partial(jax.jit, static_argnames="pixels")
def _windows(episodes: GraspEpisode, *, pixels: int) -> Window:
    """Return windows `[B]` of episodes `[B]`."""

    def one(episode: GraspEpisode) -> Window:
        half = geometry.rotate2d(jnp.full(2, WORKSPACE.pixel / 2), episode.grasp.angle)
        seen = turned_view(
            episode.scene, episode.poses, episode.grasp.center - half, episode.grasp.angle, pixels=pixels
        )
        height, label = seen.height.astype(jnp.float16), seen.label.astype(jnp.int8)
        return Window(height, label, episode.scene.color, episode.success.astype(jnp.float32))

    return jax.lax.map(one, episodes)


def windows(episodes: GraspEpisode, *, pixels: int) -> Window:
    """Return windows `[B]`, `pixels` a side, of episodes `[B]`, as NumPy arrays."""
    return jax.device_get(batching.in_batches(functools.partial(_windows, pixels=pixels), episodes))


def executed(key: jax.Array, model: nnx.Module, batch: Window, *, mirrors: tuple[int, ...]) -> jax.Array:
    """Return a network's outputs at executed actions `[B]`, with images shifted, mirrored and recoloured at random.

    Args:
      key: random key.
      model: function of images `[B, S, S, 4]` that returns maps `[B, S, S]`.
      batch: windows of the actions.
      mirrors: axes along which the images may be mirrored.
    """
    phase_key, flip_key, color_key = jax.random.split(key, 3)
    palette = jnp.asarray(shapes.COLORS_RGB, jnp.float32) / 255
    drawn = jax.random.randint(color_key, batch.color.shape[:2], 0, len(palette))
    batch = batch.replace(color=palette[drawn])  # colour must not tell the network what an object is
    images, pixel = view(batch, jax.random.randint(phase_key, (len(batch.target), 2), 0, 2 * SHIFT_PIXELS))
    mask = jnp.zeros(images.shape[:3]).at[jnp.arange(len(images)), pixel[:, 0], pixel[:, 1]].set(1.0)
    images, mask = _flips(flip_key, mirrors, images, mask)
    return (model(images) * mask).sum((1, 2))


def executed_loss(key: jax.Array, model: nnx.Module, batch: Window) -> jax.Array:
    """Return the cross entropy of the scores of executed grasps `[B]`; see `executed`."""
    logits = executed(key, model, batch, mirrors=GRASP_MIRRORS)
    return losses.score_loss(logits, batch.target, jnp.ones(len(logits)))


def view(batch: Window, begin: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cut images `[B, S, S, 4]` out of windows, S = W - 2 SHIFT_PIXELS.

    Args:
      batch: windows `[B]`, W pixels a side.
      begin: `[B, 2]` first pixel of each image.

    Returns:
      The images, and the executed pixels in them `[B, 2]`.
    """
    wide = batch.height.shape[-1]
    side = wide - 2 * SHIFT_PIXELS

    def one(window: Window, corner: jax.Array) -> jax.Array:
        cut = functools.partial(jax.lax.dynamic_slice, start_indices=corner, slice_sizes=(side, side))
        label = cut(window.label).astype(jnp.int32)
        height = cut(window.height).astype(jnp.float32)
        return render.rgbd(Observation(height, render.paint_labels(label, window.color), label, window.color.shape[0]))

    return jax.vmap(one)(batch, begin), wide // 2 - begin


class GraspTask:
    """Task of learning the outcomes of executed grasps, by the loss at the executed pixel only.

    So only a window around that pixel is rendered; windows of the `compact` network are rendered once and kept (40 KB a
    grasp).
    """

    network = "grasp"

    def __init__(
        self, data: Folders, config: grasp.GraspConfig, *, limit: int | None = None, space: Space | None = None
    ) -> None:
        """Check data sets; an episode is read when it is first fetched, with the others of its shard.

        Args:
          data: folders of grasp episodes; the last tenth of each is held out.
          config: architecture.
          limit: learn from this number of episodes only, the first ones; the same ones are held out.
          space: where episodes, and the windows of a `compact` network, are kept; None: in memory.

        Raises:
          UserError: no folder; one is damaged, or holds something else; or they have fewer episodes.
        """
        space = space or Space()
        split = load_split(data, kind="grasp", what="grasps", limit=limit, space=space)
        self.train_set, self.test_set, self.parts = split.learnt, split.held_out, split.parts
        self.fingerprint = split.fingerprint if limit is None else f"{split.fingerprint}:{limit}"
        self.size = self.examples = len(self.train_set)
        self.network_config = config
        self.window = WINDOW_PIXELS[config.preset] + 2 * SHIFT_PIXELS
        self._kept = self._keeper(self.train_set, space)
        self._held_out = self._keeper(self.test_set, Space())

    def _keeper(self, episodes: Episodes, space: Space) -> ExampleStore:
        def make(index: np.ndarray) -> Window:
            return self.prepare(episodes.take(index))

        return ExampleStore(make, len(episodes), space=space, about=f"{self.fingerprint}:{self.network_config}")

    def prepare(self, episodes: GraspEpisode) -> Window:
        """Return windows `[B]` of episodes `[B]` as NumPy arrays."""
        return windows(episodes, pixels=self.window)

    def fetch(self, index: np.ndarray) -> Window:
        """See `loop.Task`."""
        return self._take(self._kept, self.train_set, index)

    def close(self) -> None:
        """Let another process take up the windows that are kept in files."""
        self._kept.close()

    def _take(self, kept: ExampleStore, episodes: Episodes, index: np.ndarray) -> Window:
        if self.network_config.preset == "paper":
            return self.prepare(episodes.take(index))
        taken: Window = kept.take(index)
        return taken

    def loss(self, model: nnx.Module, batch: Window, key: jax.Array) -> jax.Array:
        """See `loop.Task`."""
        return executed_loss(key, model, batch)

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """See `loop.Task`: loss and accuracy on held-out grasps."""
        graph, state = nnx.split(model)
        size, rows, count = batching.BATCH, [], len(self.test_set)
        for begin in range(0, count, size):
            index = np.arange(begin, begin + size)
            weight = (index < count).astype(np.float32)
            some = self._take(self._held_out, self.test_set, index % count)
            rows.append([float(v) for v in _measure(graph, state, some, weight)])
        loss, correct = np.array(rows).sum(0) / count
        return {"held_out_loss": loss, "accuracy": correct}


@functools.partial(jax.jit, static_argnums=0)
def _measure(graph: Any, state: Any, batch: Window, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return weighted sums over grasps `[B]` of the loss and of how many are classified correctly."""
    images, pixel = view(batch, jnp.full((len(batch.target), 2), SHIFT_PIXELS))
    logits = nnx.merge(graph, state)(images)[jnp.arange(len(images)), pixel[:, 0], pixel[:, 1]]
    loss = losses.score_loss(logits, batch.target, weight) * weight.sum()
    return loss, ((logits > 0) == (batch.target > 0.5)) @ weight
