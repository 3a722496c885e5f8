"""Checkpoint -> function: what the planner and the evaluations call."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from dipn_jax.networks import dipn, grasp, local, push_frame, vpg
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Appraiser, Predictor, Scorer
from dipn_jax.sight import imagine
from dipn_jax.storage import checkpoint
from dipn_jax.structs import ABSENT, Observation, Push

Courses = Callable[[Observation, Push, jax.Array], jax.Array]
"""(observation, pushes [P], distances [P, K] metres) -> motion [P, K, N, 3]: as a Predictor's, after each distance."""


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


def dipn_motions(
    model: dipn.DIPN, observation: Observation, pushes: Push, distances: jax.Array, *, slots: int
) -> jax.Array:
    """Motions by pushes `[P]`, each on its own observation `[P, H, W]` or all on the same `[H, W]`.

    Args:
      model: in evaluation mode.
      observation: masks are its labels, whoever found them.
      pushes: `[P]`; their own distance is not looked at.
      distances: `[P, K]` metres.
      slots: N.

    Returns:
      `[P, K, N, 3]`: dx, dy (metres) of each mask's centroid, dtheta (radians), workspace.
    """
    if observation.label.ndim == 2:
        make = functools.partial(push_frame.push_input, slots=slots, view=model.config.view)
        inputs, _ = jax.vmap(make, in_axes=(None, None, 0))(observation.label, observation.height, pushes)
    else:
        view = model.config.view
        inputs, _ = push_frame.push_inputs(observation.label, observation.height, pushes, slots=slots, view=view)
    motion = dipn.symmetric(model, inputs, distances)
    return push_frame.to_workspace(motion.swapaxes(1, 2), pushes.angle[:, None])


def dipn_courses(model: dipn.DIPN, slots: int) -> Courses:
    """DIPN for many pushes and many distances of each in one call."""
    thaw = _frozen(model)

    def predict(observation: Observation, pushes: Push, distances: jax.Array) -> jax.Array:
        return dipn_motions(thaw(), observation, pushes, distances, slots=slots)  # type: ignore[arg-type]

    return predict


def dipn_predictor(model: dipn.DIPN, slots: int) -> Predictor:
    """DIPN as a predictor of each push's own distance."""
    courses = dipn_courses(model, slots)

    def predict(observation: Observation, pushes: Push) -> jax.Array:
        return courses(observation, pushes, pushes.distance[:, None])[:, 0]

    return predict


def grasp_scorer(model: grasp.GraspNet) -> Scorer:
    """GN as a scorer to act on: a `compact` one is asked with caution (`grasp.cautious_scores`), the published once."""
    return _scorer(model, grasp.cautious_scores if model.config.preset == "compact" else grasp.score_image)


def plain_scorer(model: grasp.GraspNet) -> Scorer:
    """GN as a scorer, each image asked once."""
    return _scorer(model, grasp.score_image)


def _scorer(model: nnx.Module, score: Callable[[Any, jax.Array], jax.Array]) -> Scorer:
    """One image at a time."""
    thaw = _frozen(model)

    def scores(images: jax.Array) -> jax.Array:
        network = thaw()
        return jax.lax.map(lambda image: score(network, image), images)

    return scores


def grasp_appraiser(model: grasp.GraspNet) -> Appraiser:
    """What all grasps on imagined images are worth, the fast way where there is one.

    `compact` networks on a CPU score only what moved; elsewhere images are scored whole.
    """
    if model.config.preset != "compact" or jax.default_backend() != "cpu":
        return planner.plain(plain_scorer(model))
    thaw = _frozen(model)

    def appraise(now: jax.Array, images: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
        return local.appraise(thaw(), now, images, wanted)  # type: ignore[arg-type]

    return appraise


def load_predictor(run: pathlib.Path, slots: int) -> Predictor:
    """The predictor of a `dipn-train push` run."""
    return dipn_predictor(checkpoint.load_network(run, network="dipn"), slots)  # type: ignore[arg-type]


def load_scorer(run: pathlib.Path, *, cautious: bool = True) -> Scorer:
    """The scorer of a `dipn-train grasp` run, to act on."""
    model: Any = checkpoint.load_network(run, network="grasp")
    return grasp_scorer(model) if cautious else plain_scorer(model)


def value_scorers(model: vpg.VPG) -> tuple[Scorer | None, Scorer | None]:
    """Scorers of pushes and of grasps; None where the network has no such part."""
    squash = nnx.sigmoid if model.config.answers == "chance" else (lambda x: x)

    def scorer(name: Literal["push", "grasp"]) -> Scorer | None:
        if name not in model.config.parts:
            return None
        return _scorer(getattr(model, name), functools.partial(grasp.score_image, action=name, squash=squash))

    return scorer("push"), scorer("grasp")


def load_values(run: pathlib.Path) -> tuple[Scorer | None, Scorer | None]:
    """The scorers of pushes and of grasps of a `dipn-train baseline` run."""
    return value_scorers(checkpoint.load_network(run, network="vpg"))  # type: ignore[arg-type]


def load_appraiser(run: pathlib.Path, *, network: str = "grasp", whole: bool = False) -> Appraiser:
    """What all grasps on imagined images are worth to the network of a run: GN, or the grasps of a baseline (`vpg`).

    Every image is scored `whole`, or the fast way where there is one, which does not tell the best score on each.
    """
    model: Any = checkpoint.load_network(run, network=network)
    grasps = model.grasp if network == "vpg" else model
    return planner.plain(plain_scorer(grasps)) if whole else grasp_appraiser(grasps)
