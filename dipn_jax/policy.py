"""Checkpoint -> function: what the planner and the evaluations call."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx

from dipn_jax import checkpoint, imagine
from dipn_jax.networks import dipn, grasp
from dipn_jax.planner import Predictor, Scorer
from dipn_jax.structs import ABSENT, Observation, Push


def static_predictor(slots: int) -> Predictor:
    """Baseline: nothing moves."""

    def predict(observation: Observation, pushes: Push) -> jax.Array:
        return jnp.zeros((pushes.angle.shape[0], slots, 3))

    return predict


def trans_predictor(slots: int) -> Predictor:
    """Baseline: only the pushed object moves, by the push length along the push."""

    def one(label: jax.Array, push: Push) -> jax.Array:
        hit = imagine.move_toward(label, push.start, push.angle)
        shift = push.distance * jnp.stack([jnp.cos(push.angle), jnp.sin(push.angle), jnp.zeros(())])
        return jnp.where(((jnp.arange(slots) == hit) & (hit != ABSENT))[:, None], shift, 0.0)

    def predict(observation: Observation, pushes: Push) -> jax.Array:
        return jax.vmap(one, in_axes=(None, 0))(observation.label, pushes)

    return predict


def _frozen(model: nnx.Module) -> Callable[[], nnx.Module]:
    graph, state = nnx.split(model)
    return lambda: nnx.merge(graph, state)


def dipn_predictor(model: dipn.DIPN, slots: int) -> Predictor:
    """DIPN as a predictor; masks are the observation's labels."""
    thaw, stride = _frozen(model), model.config.stride

    def predict(observation: Observation, pushes: Push) -> jax.Array:
        network = thaw()
        make = functools.partial(dipn.push_input, slots=slots, stride=stride)
        inputs, _ = jax.vmap(make, in_axes=(None, 0))(observation.label, pushes)
        return dipn.to_workspace(network(inputs), pushes.angle)

    return predict


def grasp_scorer(model: grasp.GraspNet) -> Scorer:
    """GN as a scorer, one image at a time."""
    thaw = _frozen(model)

    def score(images: jax.Array) -> jax.Array:
        network = thaw()
        return jax.lax.map(lambda image: grasp.score_image(network, image), images)  # type: ignore[arg-type]

    return score


def load_predictor(run: pathlib.Path, slots: int) -> Predictor:
    """The predictor of a `dipn-train push` run."""
    return dipn_predictor(checkpoint.load_network(run, network="dipn"), slots)  # type: ignore[arg-type]


def load_scorer(run: pathlib.Path) -> Scorer:
    """The scorer of a `dipn-train grasp` run."""
    return grasp_scorer(checkpoint.load_network(run, network="grasp"))  # type: ignore[arg-type]
