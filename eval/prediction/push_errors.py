"""How well is a push predicted? DIPN beside two simple predictors and the engine itself."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax import batching, geometry, seeds
from dipn_jax.commands import console
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.networks import losses
from dipn_jax.networks.dipn import DIPN
from dipn_jax.planning.predictors import dipn_motions, static_predictor, trans_predictor
from dipn_jax.sight import imagine, masks, segment
from dipn_jax.storage import resume
from dipn_jax.structs import Observation, Push
from dipn_jax.world.scenes import SceneConfig

from ..workers.shares import WHOLE, Share
from .pushes import DISTANCES, Executed, execute

GROUP = batching.BATCH
"""Pushes that are drawn together: a function of the seed and of their group's number, so that any worker makes them."""
MAX_ATTEMPTS = 100
"""Batches in a row without a usable push after which an evaluation gives up."""
FILMS = 6
"""Number of pushes kept as pictures."""
SEGMENTED = "_segmented"
"""End of the name of a predictor that is given masks found in the image."""
_METRES = np.array(DISTANCES, np.float32) * 0.01

Predict = Callable[[Observation, Push], jax.Array]
"""(observations [B], pushes [B]) -> motion [B, K, N, 3] after DISTANCES: dx, dy (metres), dtheta (radians)."""
Rows = dict[str, list[np.ndarray]]
"""Errors `[B, K, N]` of each batch, by predictor and measure; also which masks were `visible` and which `moved`."""


def measured(
    networks: Mapping[str, DIPN],
    engine: Engine,
    config: SceneConfig,
    partial: resume.Partial,
    *,
    scenes: int,
    seed: int,
    physics: bool,
    segmented: bool,
    share: Share = WHOLE,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Measure the errors of every predictor on the groups of held-out scenes that are this worker's.

    Args:
      networks: what to measure by the name it gets in the metrics; the first also makes the pictures.
      engine: the engine whose result counts as the truth.
      config: scenes.
      partial: where an interrupted evaluation is kept.
      scenes: number of scenes of the whole evaluation.
      seed: random seed of the scenes and pushes.
      physics: also roll the engine out with nominal mass and friction.
      segmented: also measure with masks found in the image.
      share: which groups.

    Returns:
      Errors `[B, K, N]` of each push, as Rows, and under `group` the number of its group `[B]`; and pictures `[F, ...]`
      of the first pushes of the first group (before, predicted, after 10 cm), where that is among them.
    """
    predictors = _with_baselines(networks)
    rows: Rows = {}
    films: list[dict[str, np.ndarray]] = []
    mine = share.rows(groups(scenes))
    total = sum(min(GROUP, scenes - number * GROUP) for number in mine)
    begun, rows, films = partial.load((0, rows, films))
    done = sum(min(GROUP, scenes - number * GROUP) for number in mine[:begun])
    with console.Progress("prediction", total, unit="pushes", done=done) as progress:
        for at, number in list(enumerate(mine))[begun:]:
            for executed in _group(seed, number, engine, config, min(GROUP, scenes - number * GROUP), physics=physics):
                seen = executed.seen()
                motions = measure(rows, executed, predictors, seen)
                rows.setdefault("group", []).append(np.full(len(executed), number))
                if segmented:
                    found = seen.replace(label=_found(seen, config.slots))
                    measure(rows, executed, predictors, found, suffix=SEGMENTED)
                count = min(FILMS - len(films), len(executed)) if number == 0 else 0
                films += [executed.film(seen, motions, i) for i in range(count)]
                progress.advance(len(executed))
            partial.save((at + 1, rows, films))
    joined = {key: np.concatenate(values) for key, values in rows.items()}
    return joined, {key: np.stack([film[key] for film in films]) for key in (films[0] if films else ())}


def groups(scenes: int) -> int:
    """Return the number of groups that a number of scenes is split into."""
    return -(-scenes // GROUP)


def _group(
    seed: int, number: int, engine: Engine, config: SceneConfig, count: int, *, physics: bool
) -> Iterator[Executed]:
    """Execute `count` pushes, which do not depend on those of other groups, in one batch or more.

    Raises:
      UserError: no push is feasible.
    """
    key = jax.random.fold_in(seeds.key(seed, seeds.Purpose.PREDICTION_SCENES), number)
    batch = empty = 0
    while count:
        # the first batch has the group's own key, and others are drawn for what was not feasible in it
        executed = execute(jax.random.fold_in(key, batch) if batch else key, engine, config, count, physics=physics)
        batch, empty, count = batch + 1, 0 if len(executed) else empty + 1, count - len(executed)
        if empty == MAX_ATTEMPTS:
            raise UserError(f"prediction: {MAX_ATTEMPTS} batches without a feasible push; give fewer --objects")
        if len(executed):
            yield executed


def _with_baselines(networks: Mapping[str, DIPN]) -> dict[str, Predict]:
    """Return the networks as predictors, then `static` (nothing moves) and `trans` (the pushed object moves along)."""
    predictors = {name: network_predictor(network) for name, network in networks.items()}
    return predictors | {
        "static": at_distances(static_predictor),
        "trans": at_distances(trans_predictor),
    }


def network_predictor(network: DIPN) -> Predict:
    """Return a network as it is measured here; networks of one architecture share a compiled function."""
    graph, state = nnx.split(network)
    distances = lambda count: np.broadcast_to(_METRES, (count, len(_METRES)))  # noqa: E731
    return lambda seen, pushes: batching.in_batches(
        lambda *rows: _network_motions(graph, state, *rows), seen, pushes, distances(len(pushes.angle))
    )


@functools.partial(jax.jit, static_argnums=0)
def _network_motions(graph: Any, state: Any, seen: Observation, pushes: Push, distances: jax.Array) -> jax.Array:
    return dipn_motions(nnx.merge(graph, state), seen, pushes, distances)


def at_distances(predictor: Callable[[Observation, Push], jax.Array]) -> Predict:
    """Make a planner's predictor into one of batches; a baseline's push is made once for each distance."""

    @jax.jit
    def predict(seen: Observation, pushes: Push) -> jax.Array:
        def one(pair: tuple[Observation, Push]) -> jax.Array:
            repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], len(_METRES), 0), pair[1])
            return predictor(pair[0], repeated.replace(distance=jnp.asarray(_METRES)))

        return jax.lax.map(one, (seen, pushes))

    return lambda seen, pushes: batching.in_batches(predict, seen, pushes)


def _found(seen: Observation, slots: int) -> np.ndarray:
    """Find masks in the images and return their labels `[B, H, W]`, numbered as the objects that they overlap most."""
    images = zip(seen.height, seen.color, seen.label, strict=True)
    return np.stack([segment.segment_as(*image, slots=slots)[0] for image in images])


def measure(
    rows: Rows, executed: Executed, predictors: Mapping[str, Predict], seen: Observation, *, suffix: str = ""
) -> np.ndarray:
    """Append the errors of a batch to `rows`; return the first predictor's motions `[B, K, N, 3]`.

    Args:
      rows: grows by `NAME SUFFIX/MEASURE` `[B, K, N]` for each predictor, and by `visible` and `moved` where there is
        no suffix: `seen` then has the true labels.
      executed: pushes `[B]` and what they did; `rolled` is measured as the predictor `physics`.
      predictors: what to measure.
      seen: `[B]` what the predictors see.
      suffix: end of the predictors' names.
    """
    truth, after = executed.truth, executed.labels_after
    centers, motion = batching.in_batches(_true_motion, seen.label, truth)
    if not suffix:
        visible = np.asarray((seen.label[..., None] == np.arange(truth.shape[2])).any((1, 2)))
        rows.setdefault("visible", []).append(np.repeat(visible[:, None], len(DISTANCES), 1))
        rows.setdefault("moved", []).append(np.asarray(losses.moved(motion)) & visible[:, None])
    motions = {name: predictor(seen, executed.pushes) for name, predictor in predictors.items()}
    if executed.rolled is not None:
        before_rolled = np.concatenate([truth[:, :1], executed.rolled], 1)
        motions["physics"] = batching.in_batches(_true_motion, seen.label, before_rolled)[1]
    for name, predicted in motions.items():
        errors = batching.in_batches(_errors, seen, centers, predicted, motion, after)
        for key, value in errors.items():
            rows.setdefault(f"{name}{suffix}/{key}", []).append(np.asarray(value))
    return np.asarray(next(iter(motions.values())))


@jax.jit
def _true_motion(label: jax.Array, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return centroids `[B, N, 2]` of visible masks and how poses `[B, 1 + K, N, 7]` move them `[B, K, N, 3]`."""
    centers, _ = jax.vmap(lambda one: masks.mask_centers(one, poses.shape[2]))(label)
    return centers, geometry.planar_motion(poses[:, :1], poses[:, 1:], centers[:, None])


@jax.jit
def _errors(
    seen: Observation, centers: jax.Array, motion: jax.Array, true_motion: jax.Array, after: jax.Array
) -> dict[str, jax.Array]:
    """Return the errors `[B, K, N]` of motions `[B, K, N, 3]` against true ones and true labels `[B, K, H, W]`."""
    slots = centers.shape[1]

    def one(args: tuple[Observation, jax.Array, jax.Array, jax.Array]) -> Any:
        image, center, motions, labels = args
        return jax.lax.map(
            lambda pair: losses.mask_errors(imagine.imagine(image, center, pair[0]).label, pair[1], slots),
            (motions, labels),
        )

    iou, xor = jax.lax.map(one, (seen, centers, motion, after))
    return {
        "push_error": iou,
        "push_error_paper_measure": xor,
        "push_position_mm": jnp.linalg.norm((motion - true_motion)[..., :2], axis=-1) * 1000,
        "push_angle_deg": jnp.abs(geometry.wrap_angle((motion - true_motion)[..., 2])) * 180 / jnp.pi,
    }


def summary(joined: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return flat metrics of errors `[B, K, N]`, as `measured` returns them."""
    metrics: dict[str, float] = {}
    measures = [key.rpartition("/")[0] for key in joined if key.endswith("/push_error")]
    names = [name for name in measures if not name.endswith(SEGMENTED)]
    segmented = len(measures) > len(names)

    def mean(key: str, k: int, counted: np.ndarray) -> float:
        return float(joined[key][:, k][counted].mean()) if counted.any() else float("nan")

    for k, centimetres in enumerate(DISTANCES):
        visible, moved = joined["visible"][:, k], joined["moved"][:, k]
        for name in names:
            at = f"{name}/{centimetres}cm"
            for key in ("push_error", "push_error_paper_measure"):
                metrics[f"{key}/{at}/all"] = mean(f"{name}/{key}", k, visible)
                metrics[f"{key}/{at}/moved"] = mean(f"{name}/{key}", k, moved)
                if segmented:
                    title = key.replace("push_error", "push_error_segmented")
                    metrics[f"{title}/{at}/all"] = mean(f"{name}{SEGMENTED}/{key}", k, visible)
                    metrics[f"{title}/{at}/moved"] = mean(f"{name}{SEGMENTED}/{key}", k, moved)
            for key in ("push_position_mm", "push_angle_deg"):
                metrics[f"{key}/{at}/moved"] = mean(f"{name}/{key}", k, moved)
        metrics[f"objects_moved/{centimetres}cm"] = int(moved.sum())
    metrics["objects"] = int(visible.sum())
    metrics["pushes"] = len(visible)
    return metrics
