"""Predictors, functions that say where every object goes when one is pushed: two baselines, and DIPN."""

from __future__ import annotations

import functools
import pathlib

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float

from dipn_jax.networks import dipn, push_frame
from dipn_jax.planning.planner import Predictor
from dipn_jax.sight import imagine
from dipn_jax.storage import checkpoint
from dipn_jax.structs import ABSENT, Array, Observation, Push


def static_predictor(observation: Observation, pushes: Push) -> Float[jax.Array, "P N 3"]:
    """Predict that nothing moves: a baseline, a Predictor."""
    return jnp.zeros((pushes.angle.shape[0], observation.slots, 3))


def trans_predictor(observation: Observation, pushes: Push) -> Float[jax.Array, "P N 3"]:
    """Predict that only the pushed object moves, by the push length along the push: a baseline, a Predictor."""

    def one(label: Array, push: Push) -> jax.Array:
        hit = imagine.first_object_hit(label, push.start, push.angle)
        shift = push.distance * jnp.stack([jnp.cos(push.angle), jnp.sin(push.angle), jnp.zeros(())])
        return jnp.where(((jnp.arange(observation.slots) == hit) & (hit != ABSENT))[:, None], shift, 0.0)

    return jax.vmap(one, in_axes=(None, 0))(observation.label, pushes)


def dipn_motions(
    model: dipn.DIPN,
    observation: Observation,
    pushes: Push,
    distances: Float[Array, "P K"],
    *,
    mirrors: bool = True,
) -> Float[jax.Array, "P K N 3"]:
    """Predict motions by pushes `[P]`, each on its own observation `[P, H, W]` or all on the same `[H, W]`.

    Args:
      model: in evaluation mode.
      observation: its labels are the masks, from the simulator or found in the image.
      pushes: `[P]`; their own distance is not looked at.
      distances: metres.
      mirrors: average over the push and its mirror image (`dipn.symmetric`).

    Returns:
      dx, dy (metres) of each mask's centroid, dtheta (radians), workspace.
    """
    slots, view = observation.slots, model.config.view
    if observation.label.ndim == 2:
        make = functools.partial(push_frame.push_input, slots=slots, view=view)
        inputs, _ = jax.vmap(make, in_axes=(None, None, 0))(observation.label, observation.height, pushes)
    else:
        inputs, _ = push_frame.push_inputs(observation.label, observation.height, pushes, slots=slots, view=view)
    motion = (dipn.symmetric if mirrors else dipn.DIPN.__call__)(model, inputs, distances)
    return push_frame.to_workspace(motion.swapaxes(1, 2), pushes.angle[:, None])


def dipn_predictor(model: dipn.DIPN, *, mirrors: bool = True) -> Predictor:
    """Return DIPN as a predictor; every push goes its own distance. `mirrors` as of `dipn_motions`."""
    graph, state = nnx.split(model)

    def predict(observation: Observation, pushes: Push) -> Float[jax.Array, "P N 3"]:
        network = nnx.merge(graph, state)
        return dipn_motions(network, observation, pushes, pushes.distance[:, None], mirrors=mirrors)[:, 0]

    return predict


def load_predictor(run: pathlib.Path | str, *, mirrors: bool = True) -> Predictor:
    """Load the predictor of a `dipn-train push` run, or `builtin`; `mirrors` as of `dipn_motions`.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    model = checkpoint.load_network(pathlib.Path(run), network="dipn")
    return dipn_predictor(model, mirrors=mirrors)  # type: ignore[arg-type]
