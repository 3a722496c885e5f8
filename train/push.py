"""DIPN's task: motions of every object at any recorded distance of a push."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import geometry, losses, records, render, shapes, structs
from dipn_jax.errors import UserError
from dipn_jax.networks import dipn, push_frame
from dipn_jax.networks.push_frame import PushInput, View
from dipn_jax.structs import PushEpisode
from dipn_jax.workspace import PUSH_STEPS
from train.split import split


class PushTask:
    """Episodes in, motions out. A tenth of the episodes, the last ones, is held out for the learning curve."""

    network = "dipn"

    def __init__(
        self,
        data: pathlib.Path,
        config: dipn.DipnConfig,
        *,
        limit: int | None,
        centimetres: tuple[int, ...],
        without: tuple[str, ...] = (),
    ) -> None:
        """Load a data set.

        Args:
          data: folder of push episodes.
          config: architecture.
          limit: use only the first so many episodes.
          centimetres: distances learnt, each 1 to 10.
          without: leave out scenes with an object of these classes (`shapes.CLASSES`).
        """
        if not centimetres or min(centimetres) < 1 or max(centimetres) > PUSH_STEPS:
            raise UserError(f"--centimetres {centimetres}: want whole numbers from 1 to {PUSH_STEPS}")
        episodes, fingerprint = records.load(data, kind="push")
        if without:
            classes = [shapes.CLASSES.index(name) for name in without]
            kept = np.flatnonzero(~np.isin(episodes.scene.shape, classes).any(1))
            episodes = structs.take(episodes, kept)
        count = len(episodes.fault)
        if limit is not None and not 2 <= limit <= count:
            raise UserError(f"--limit {limit}: want 2 to {count}, the number of episodes of {data} to use")
        count = count if limit is None else limit
        self.train_set, self.test_set = split(structs.take(episodes, slice(0, count)), data)
        self.network_config = config
        self.size, self.examples = len(self.train_set.fault), count
        self.fingerprint = ":".join(map(str, (fingerprint, count, centimetres, *without)))
        self.centimetres = np.array(centimetres, np.int32)
        self.slots = episodes.scene.shape.shape[1]
        shortest = 100 * float(np.min(episodes.push.distance))
        if min(centimetres) > shortest + 0.01:
            raise UserError(
                f"--centimetres {centimetres}: {data} has pushes of {shortest:.0f} cm; give as low a number"
            )

    def fetch(self, index: np.ndarray) -> PushEpisode:
        """See `loop.Task`."""
        return structs.take(self.train_set, index)

    def prepare(self, episodes: PushEpisode, centimetres: jax.Array) -> tuple[PushInput, jax.Array]:
        """Inputs `[B]` and targets `[B, N, K, 3]` (pixels, degrees, push frame) at `centimetres [B, K]`."""
        make = functools.partial(example, slots=self.slots, view=self.network_config.view)
        return push_frame.over_batch(make, episodes, centimetres)

    def loss(self, model: nnx.Module, batch: PushEpisode, key: jax.Array) -> jax.Array:
        """See `loop.Task`: SmoothL1 in pixels and degrees; half of the examples are mirrored.

        `compact` is taught every distance by every example, `paper`, which has one output, a random one.
        """
        count = batch.fault.shape[0]
        distance_key, mirror_key = jax.random.split(key)
        taught = self._recorded(batch)
        if self.network_config.preset == "paper":
            drawn = jax.random.categorical(distance_key, jnp.log(taught.astype(jnp.float32)))
            centimetres, taught = jnp.asarray(self.centimetres)[drawn][:, None], jnp.ones((count, 1), bool)
        else:
            centimetres = jnp.broadcast_to(self.centimetres, taught.shape)
        inputs, target = self.prepare(batch, centimetres)
        flipped = jax.random.bernoulli(mirror_key, 0.5, (count,))

        def pick(mirrored: jax.Array, seen: jax.Array) -> jax.Array:
            return jnp.where(flipped.reshape(-1, *[1] * (seen.ndim - 1)), mirrored, seen)

        inputs = jax.tree.map(pick, push_frame.mirror(inputs), inputs)
        target = pick(push_frame.mirror_motion(target), target)
        predicted = model(inputs, centimetres * 0.01)
        return losses.motion_loss(predicted, target, inputs.present[..., None] & taught[:, None])

    def _recorded(self, episodes: PushEpisode) -> jax.Array:
        """Which of the distances learnt the pushes `[B]` reach: `[B, centimetres]` bool."""
        return jnp.asarray(self.centimetres[None] * 0.01) <= jnp.asarray(episodes.push.distance)[:, None] + 1e-4

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """See `loop.Task`: loss, and position error of moved objects (mm), at the largest distance."""
        total: dict[str, list[Any]] = {"held_out_loss": [], "moved_error_mm": []}
        graph, state = nnx.split(model)
        size = 32
        for begin in range(0, len(self.test_set.fault), size):
            index = np.arange(begin, begin + size) % len(self.test_set.fault)
            weight = np.arange(begin, begin + size) < len(self.test_set.fault)
            episodes = structs.take(self.test_set, index)
            loss, error, moved = self._measure(graph, state, episodes, jnp.asarray(weight))
            total["held_out_loss"].append((float(loss), int(weight.sum())))
            total["moved_error_mm"].append((float(error), float(moved)))
        return {name: sum(v * w for v, w in rows) / max(sum(w for _, w in rows), 1e-9) for name, rows in total.items()}

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _measure(self, graph: Any, state: Any, episodes: PushEpisode, weight: jax.Array) -> tuple[jax.Array, ...]:
        model = nnx.merge(graph, state)
        farthest = jnp.where(self._recorded(episodes), self.centimetres, 0).max(-1, keepdims=True)
        inputs, target = self.prepare(episodes, farthest)
        predicted = model(inputs, farthest * 0.01)
        counted = inputs.present[..., None] & weight[:, None, None]
        loss = losses.motion_loss(predicted, target, counted)
        moved = losses.moved(target / losses.PIXELS_DEGREES) & counted
        error = jnp.linalg.norm((predicted - target)[..., :2], axis=-1) / losses.PIXELS_DEGREES[0] * 1000
        return loss, (error * moved).sum() / jnp.maximum(moved.sum(), 1), moved.sum()


def example(episode: PushEpisode, centimetres: jax.Array, *, slots: int, view: View) -> tuple[PushInput, jax.Array]:
    """One episode as input and targets `[N, K, 3]` (pixels, degrees, push frame) after `centimetres [K]`."""
    before = episode.poses[0]
    height, label = render.render_depth(episode.scene, before)
    inputs, centers = push_frame.push_input(label, height, episode.push, slots=slots, view=view)
    motion = jax.vmap(lambda after: geometry.planar_motion(before, after, centers))(episode.poses[centimetres])
    return inputs, push_frame.from_workspace(motion, episode.push.angle).swapaxes(0, 1)
