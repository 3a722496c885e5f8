"""Scorers, functions that say what a network thinks of grasps, pushes and whole images."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable
from typing import Any, Literal

import jax
from flax import nnx

from dipn_jax.networks import grasp, local, vpg
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Scorer, ScoreSummary
from dipn_jax.storage import checkpoint


def _frozen(model: nnx.Module) -> Callable[[], nnx.Module]:
    graph, state = nnx.split(model)
    return lambda: nnx.merge(graph, state)


def _scorer(model: nnx.Module, score: Callable[[Any, jax.Array], jax.Array]) -> Scorer:
    """Return a scorer that applies `score` to one image after another."""
    thaw = _frozen(model)

    def scores(images: jax.Array) -> jax.Array:
        network = thaw()
        return jax.lax.map(lambda image: score(network, image), images)

    return scores


def cautious_scorer(model: grasp.GraspNet) -> Scorer:
    """Return GN as a scorer to choose by: `grasp.cautious_scores` of `compact`, plain scores of `paper`."""
    return _scorer(model, grasp.cautious_scores if model.config.preset == "compact" else grasp.score_image)


def plain_scorer(model: grasp.GraspNet) -> Scorer:
    """Return GN as a scorer with its scores as they are."""
    return _scorer(model, grasp.score_image)


def grasp_summary(model: grasp.GraspNet) -> ScoreSummary:
    """Return the function that summarizes scores of imagined images, the fast way where there is one.

    `compact` networks on a CPU score only what moved; elsewhere images are scored whole. The highest score of the fast
    way is not that of the image.
    """
    if model.config.preset != "compact" or jax.default_backend() != "cpu":
        return planner.summarize_whole(plain_scorer(model))
    thaw = _frozen(model)

    def summarize(now: jax.Array, images: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
        return local.mean_and_best(thaw(), now, images, wanted)  # type: ignore[arg-type]

    return summarize


def value_scorers(model: vpg.VPG) -> tuple[Scorer | None, Scorer | None]:
    """Return the scorers of pushes and of grasps of a baseline's network; None where it has no such part."""
    squash = nnx.sigmoid if model.config.answers == "chance" else (lambda x: x)

    def scorer(name: Literal["push", "grasp"]) -> Scorer | None:
        if name not in model.config.parts:
            return None
        return _scorer(getattr(model, name), functools.partial(grasp.score_image, action=name, squash=squash))

    return scorer("push"), scorer("grasp")


def load_scorer(run: pathlib.Path | str, *, cautious: bool = True) -> Scorer:
    """Load the scorer of a `dipn-train grasp` run, or `builtin`, to choose grasps by.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    model: Any = checkpoint.load_network(pathlib.Path(run), network="grasp")
    return cautious_scorer(model) if cautious else plain_scorer(model)


def load_values(run: pathlib.Path | str) -> tuple[Scorer | None, Scorer | None]:
    """Load the scorers of pushes and grasps of a `dipn-train baseline` run; None for a part that was not trained.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    return value_scorers(checkpoint.load_network(pathlib.Path(run), network="vpg"))  # type: ignore[arg-type]


def load_summary(
    run: pathlib.Path | str, *, network: Literal["grasp", "vpg"] = "grasp", whole: bool = False
) -> ScoreSummary:
    """Load the function that summarizes a network's scores of imagined images by mean and highest.

    Args:
      run: of `dipn-train grasp` (or `builtin`), or of `dipn-train baseline`.
      network: GN (`grasp`), or the grasps of a baseline (`vpg`).
      whole: score every image whole; the fast way does not know the highest score on each.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    model: Any = checkpoint.load_network(pathlib.Path(run), network=network)
    grasps = model.grasp if network == "vpg" else model
    return planner.summarize_whole(plain_scorer(grasps)) if whole else grasp_summary(grasps)
