"""DIPN's task: to predict the motions of all objects at any recorded distance of a push."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Bool, Float

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.networks import dipn, losses, push_frame
from dipn_jax.networks.push_frame import PushInput, View
from dipn_jax.sight import render, segment
from dipn_jax.storage.on_demand import DataSet, Episodes
from dipn_jax.storage.space import Space
from dipn_jax.structs import Array, PushEpisode, Pytree
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import shapes

from .example_store import ExampleStore
from .split import Folders, load_split


@flax.struct.dataclass
class Example(Pytree):
    """One push as an example, at K distances."""

    inputs: PushInput
    target: Float[Array, "*b N K 3"]  # pixels, pixels, degrees, push frame
    taught: Bool[Array, "*b N K"]  # the object's mask belongs to a real one, and the push reaches the distance


class PushTask:
    """Task of learning motions from push episodes; their last tenth is held out for the learning curve."""

    network = "dipn"

    def __init__(
        self,
        data: Folders,
        config: dipn.DipnConfig,
        *,
        limit: int | None,
        centimetres: tuple[int, ...],
        without: tuple[str, ...] = (),
        found: bool = False,
        space: Space | None = None,
    ) -> None:
        """Check data sets; an episode is read when it is first fetched, with the others of its shard.

        Args:
          data: folders of push episodes; the last tenth of each is held out.
          config: architecture.
          limit: learn from this number of episodes only, the first ones; the same ones are held out.
          centimetres: distances learnt, each 1 to 10.
          without: leave out scenes with an object of these classes (`shapes.CLASSES`).
          found: masks are found in the image by `segment`, not taken from the simulator.
          space: where episodes, and the examples of a `compact` network, are kept; None: in memory.
        """
        if not centimetres or min(centimetres) < 1 or max(centimetres) > PUSH_STEPS:
            raise UserError(
                f"--centimetres {' '.join(map(str, centimetres))}: want whole numbers from 1 to {PUSH_STEPS}"
            )

        def choose(of: DataSet, folder: pathlib.Path) -> np.ndarray | None:
            return _chosen(of, folder, centimetres, without)

        space = space or Space()
        split = load_split(data, kind="push", what="pushes", choose=choose, limit=limit, space=space)
        self.train_set, self.test_set, self.parts = split.learnt, split.held_out, split.parts
        count = len(self.train_set)
        self.network_config = config
        self.size = self.examples = count
        masks = ("found",) if found else ()
        self.fingerprint = ":".join(map(str, (split.fingerprint, count, centimetres, *without, *masks)))
        self.centimetres = np.array(centimetres, np.int32)
        self.found = found
        self.slots = self.train_set.slots
        self._kept = self._keeper(self.train_set, space)
        self._held_out = self._keeper(self.test_set, Space())

    def _keeper(self, episodes: Episodes, space: Space) -> ExampleStore:
        def make(index: np.ndarray) -> Example:
            return _halved(self.prepare(episodes.take(index)))

        return ExampleStore(make, len(episodes), space=space, about=f"{self.fingerprint}:{self.network_config}")

    def fetch(self, index: np.ndarray) -> Example:
        """See `loop.Task`. A `compact` network's examples are small (20 KB), and kept once they have been rendered."""
        return self._take(self._kept, self.train_set, index)

    def close(self) -> None:
        """Let another process take up the examples that are kept in files."""
        self._kept.close()

    def _take(self, kept: ExampleStore, episodes: Episodes, index: np.ndarray) -> Example:
        if self.network_config.preset == "paper":
            return self.prepare(episodes.take(index))
        taken: Example = kept.take(index)
        return taken

    def prepare(self, episodes: PushEpisode) -> Example:
        """Return examples `[B]` of episodes `[B]`; rendered, and moved into the push frame, on the device."""
        label, height, color = _look(episodes)
        counted = np.ones(episodes.scene.shape.shape, bool)
        if self.found:
            images = zip(*map(np.asarray, (height, color, label)), strict=True)
            each = [segment.segment_as(*image, slots=self.slots) for image in images]
            label, counted = np.stack([one[0] for one in each]), np.stack([one[1] for one in each])
        view = self.network_config.view
        return _examples(label, height, episodes, counted, self.centimetres, slots=self.slots, view=view)

    def loss(self, model: nnx.Module, batch: Example, key: jax.Array) -> jax.Array:
        """See `loop.Task`: SmoothL1 in pixels and degrees.

        `compact` learns all distances from every example, half of them mirrored; `paper`, which has one output, learns
        a random one, and as in its released code nothing is mirrored and the loss is the mean over coordinates.
        """
        count = batch.taught.shape[0]
        distance_key, mirror_key = jax.random.split(key)
        inputs, target, taught = _single(batch.inputs), batch.target, batch.taught
        centimetres = jnp.broadcast_to(self.centimetres, (count, len(self.centimetres)))
        if self.network_config.preset == "paper":
            reached = taught.any(1)
            drawn = jax.random.categorical(distance_key, jnp.log(reached.astype(jnp.float32)))[:, None]
            centimetres = jnp.take_along_axis(centimetres, drawn, 1)
            target = jnp.take_along_axis(target, drawn[:, None, :, None], 2)
            taught = jnp.take_along_axis(taught, drawn[:, None], 2)
        else:
            inputs, target = _mirrored(mirror_key, inputs, target)
        predicted = model(inputs, centimetres * 0.01)
        return self._share * losses.motion_loss(predicted, target, inputs.present[..., None] & taught)

    @property
    def _share(self) -> float:
        """Factor of the sum over the three coordinates: `paper` takes the mean."""
        return 1 / 3 if self.network_config.preset == "paper" else 1.0

    def evaluate(self, model: nnx.Module) -> dict[str, float]:
        """See `loop.Task`: loss, and position error of moved objects (mm), at the largest distance."""
        total: dict[str, list[Any]] = {"held_out_loss": [], "moved_error_mm": []}
        graph, state = nnx.split(model)
        size, count = 32, len(self.test_set)
        for begin in range(0, count, size):
            index = np.arange(begin, begin + size) % count
            weight = np.arange(begin, begin + size) < count
            examples = self._take(self._held_out, self.test_set, index)
            loss, error, moved = _measure(graph, state, examples, self.centimetres, jnp.asarray(weight))
            total["held_out_loss"].append((self._share * float(loss), int(weight.sum())))
            total["moved_error_mm"].append((float(error), float(moved)))
        return {name: sum(v * w for v, w in rows) / max(sum(w for _, w in rows), 1e-9) for name, rows in total.items()}


def _chosen(
    of: DataSet, folder: pathlib.Path, centimetres: tuple[int, ...], without: tuple[str, ...]
) -> np.ndarray | None:
    """Return the numbers of those episodes of a data set that have no object of some classes; None for all.

    Raises:
      UserError: none is left, or pushes are shorter than the distances that are to be learnt.
    """
    kept, distances = None, of.column("push.distance")
    if without:
        classes = [shapes.CLASSES.index(name) for name in without]
        kept = np.flatnonzero(~np.isin(of.column("scene.shape"), classes).any(1))
        if not len(kept):
            raise UserError(f"--without {' '.join(without)}: leaves none of the pushes of {folder}; name fewer classes")
        distances = distances[kept]
    shortest = 100 * float(np.min(distances))
    if min(centimetres) > shortest + 0.01:
        given = " ".join(map(str, centimetres))
        raise UserError(f"--centimetres {given}: {folder} has pushes of {shortest:.0f} cm; give as low a number")
    return kept


def _mirrored(key: jax.Array, inputs: PushInput, target: Array) -> tuple[PushInput, jax.Array]:
    """Mirror half of the examples `[B]`, at random, in the axis of the push."""
    flipped = jax.random.bernoulli(key, 0.5, (target.shape[0],))

    def pick(mirrored: Array, seen: Array) -> jax.Array:
        return jnp.where(flipped.reshape(-1, *[1] * (seen.ndim - 1)), mirrored, seen)

    inputs = jax.tree.map(pick, push_frame.mirror(inputs), inputs)
    return inputs, pick(push_frame.mirror_motion(target), target)


def _halved(example: Example) -> Example:
    """Return an example whose crops are in half precision, as examples are kept."""
    return example.replace(inputs=example.inputs.replace(crops=example.inputs.crops.astype(np.float16)))


def _single(inputs: PushInput) -> PushInput:
    """Return inputs whose crops are in single precision; they are stored in half precision."""
    return inputs.replace(crops=inputs.crops.astype(jnp.float32))


@functools.partial(jax.jit, static_argnums=0)
def _measure(
    graph: Any, state: Any, batch: Example, centimetres: jax.Array, weight: jax.Array
) -> tuple[jax.Array, ...]:
    """Return loss, error (mm) and number of moved objects at the largest distance of each push."""
    inputs = _single(batch.inputs)
    farthest = jnp.where(batch.taught.any(1), centimetres, 0).argmax(-1)[:, None]
    predicted = nnx.merge(graph, state)(inputs, centimetres[farthest] * 0.01)
    target = jnp.take_along_axis(batch.target, farthest[:, None, :, None], 2)
    taught = jnp.take_along_axis(batch.taught, farthest[:, None], 2)
    counted = inputs.present[..., None] & weight[:, None, None] & taught
    loss = losses.motion_loss(predicted, target, counted)
    moved = losses.moved(target / losses.PIXELS_DEGREES) & counted
    error = jnp.linalg.norm((predicted - target)[..., :2], axis=-1) / losses.PIXELS_DEGREES[0] * 1000
    return loss, (error * moved).sum() / jnp.maximum(moved.sum(), 1), moved.sum()


@jax.jit
def _look(episodes: PushEpisode) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return labels, heights and colours `[B, ...]` before the pushes."""

    def one(episode: PushEpisode) -> tuple[jax.Array, jax.Array, jax.Array]:
        seen = render.render(episode.scene, episode.poses[0])
        return seen.label, seen.height, seen.color

    return push_frame.over_batch(one, episodes)


@functools.partial(jax.jit, static_argnames=("slots", "view"))
def _examples(
    label: jax.Array,
    height: jax.Array,
    episodes: PushEpisode,
    counted: jax.Array,
    centimetres: jax.Array,
    *,
    slots: int,
    view: View,
) -> Example:
    """Return examples `[B]` of labels and heights `[B, H, W]` before pushes; masks `counted [B, N]` are learnt from."""

    def one(label: jax.Array, height: jax.Array, episode: PushEpisode, counted: jax.Array) -> Example:
        inputs, centers = push_frame.push_input(label, height, episode.push, slots=slots, view=view)
        move = lambda after: geometry.planar_motion(episode.poses[0], after, centers)  # noqa: E731
        motion = push_frame.from_workspace(jax.vmap(move)(episode.poses[centimetres]), episode.push.angle)
        reached = centimetres * 0.01 <= episode.push.distance + 1e-4
        return Example(inputs, motion.swapaxes(0, 1), counted[:, None] & reached)

    return push_frame.over_batch(one, label, height, episodes, counted)
