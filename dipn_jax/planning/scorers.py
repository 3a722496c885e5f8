"""Scorers: functions that return a network's scores of grasps or pushes, or summaries of whole images."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable, Collection
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Bool, Float

from dipn_jax.names import ALL_AIDS, Aid
from dipn_jax.networks import grasp, partial_scoring, vpg
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Scorer, ScoreSummary
from dipn_jax.storage import checkpoint

TABLE_AID: tuple[Aid, ...] = ("table",)
"""The one aid that the compared networks choose grasps with while they learn."""


def _frozen(model: nnx.Module) -> Callable[[], nnx.Module]:
    graph, state = nnx.split(model)
    return lambda: nnx.merge(graph, state)


def _scorer(model: nnx.Module, score: Callable[[Any, jax.Array], jax.Array]) -> Scorer:
    """Return a scorer that applies `score` to one image after another."""
    thaw = _frozen(model)

    def scores(images: Float[jax.Array, "M H W 4"]) -> Float[jax.Array, "M R H W"]:
        network = thaw()
        return jax.lax.map(lambda image: score(network, image), images)

    return scores


def aided_scorer(model: grasp.GraspNet, *, aids: Collection[Aid] = ALL_AIDS) -> Scorer:
    """Return the scorer that grasps are chosen by: GN with the given aids (`names.Aid`)."""
    return _scorer(model, functools.partial(grasp.aided_scores, aids=tuple(aids)))


def unaided_scorer(model: grasp.GraspNet, *, table: bool = True) -> Scorer:
    """Return GN as a scorer with its scores as they are, but 0 for grasps centred on empty table if `table` is True."""
    return _scorer(model, functools.partial(grasp.score_image, table=table))


def grasp_summary(model: grasp.GraspNet, *, table: bool = True) -> ScoreSummary:
    """Return the function that summarizes scores of imagined images, the fast way where there is one.

    `compact` networks on a CPU score only what moved; elsewhere, and where empty table counts (`table` False), images
    are scored whole. The highest score of the fast way is not that of the image.
    """
    if model.config.preset != "compact" or jax.default_backend() != "cpu" or not table:
        return planner.summarize_whole(unaided_scorer(model, table=table))
    thaw = _frozen(model)

    def summarize(
        now: Float[jax.Array, "H W 4"], images: Float[jax.Array, "P H W 4"], wanted: Bool[jax.Array, " P"]
    ) -> tuple[Float[jax.Array, " Q"], Float[jax.Array, " Q"]]:
        return partial_scoring.mean_and_best(thaw(), now, images, wanted)  # type: ignore[arg-type]

    return summarize


def value_scorers(model: vpg.VPG, *, aids: Collection[Aid] = TABLE_AID) -> tuple[Scorer | None, Scorer | None]:
    """Return the scorers of pushes and of grasps of a baseline's network; None where it has no such part.

    Args:
      model: the network.
      aids: that grasps are chosen with; pushes have none.
    """
    chance = model.config.answers == "chance"
    squash, lowest = (nnx.sigmoid, 0.0) if chance else ((lambda x: x), -jnp.inf)
    push, grasps = (getattr(model, name) if name in model.config.parts else None for name in vpg.NETWORK_PARTS)
    score_push = functools.partial(grasp.score_image, action="push", squash=squash)
    score_grasp = functools.partial(grasp.aided_scores, aids=tuple(aids), squash=squash, lowest=lowest)
    return (
        None if push is None else _scorer(push, score_push),
        None if grasps is None else _scorer(grasps, score_grasp),
    )


def load_unaided_scorer(run: pathlib.Path | str, *, table: bool = True) -> Scorer:
    """Load the scorer of a `dipn-train grasp` run, or `builtin`, with its scores as they are; see `unaided_scorer`.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    return unaided_scorer(checkpoint.load_network(pathlib.Path(run), network="grasp"), table=table)  # type: ignore[arg-type]


def load_scorer(run: pathlib.Path | str, *, aids: Collection[Aid] = ALL_AIDS) -> Scorer:
    """Load the scorer of a `dipn-train grasp` run, or `builtin`, to choose grasps by, with some of the aids.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    model: Any = checkpoint.load_network(pathlib.Path(run), network="grasp")
    return aided_scorer(model, aids=aids)


def load_values(run: pathlib.Path | str, *, aids: Collection[Aid] = TABLE_AID) -> tuple[Scorer | None, Scorer | None]:
    """Load the scorers of pushes and grasps of a `dipn-train baseline` run; None for a part that was not trained.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    return value_scorers(checkpoint.load_network(pathlib.Path(run), network="vpg"), aids=aids)  # type: ignore[arg-type]


def load_summary(
    run: pathlib.Path | str,
    *,
    network: Literal["grasp", "vpg"] = "grasp",
    whole: bool = False,
    table: bool = True,
) -> ScoreSummary:
    """Load the function that summarizes a network's scores of imagined images by mean and highest.

    Args:
      run: of `dipn-train grasp` (or `builtin`), or of `dipn-train baseline`.
      network: GN (`grasp`), or the grasps of a baseline (`vpg`).
      whole: score every image whole; the fast way does not know the highest score on each.
      table: whether grasps centred on empty table score 0.

    Raises:
      UserError: as `checkpoint.load_network`.
    """
    model: Any = checkpoint.load_network(pathlib.Path(run), network=network)
    grasps = model.grasp if network == "vpg" else model
    return planner.summarize_whole(unaided_scorer(grasps, table=table)) if whole else grasp_summary(grasps, table=table)
