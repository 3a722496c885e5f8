"""How far should one push? Prediction, completion and efficiency at each distance, and a policy that chooses it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from dipn_jax import batching, geometry, seeds, structs
from dipn_jax.commands import console, pages
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.networks import losses
from dipn_jax.planning import candidates
from dipn_jax.planning.planner import Predictor
from dipn_jax.sight import imagine, masks, render
from dipn_jax.structs import Fault, Observation, Push, Scene
from dipn_jax.world import clutter, primitives
from dipn_jax.world.scenes import SceneConfig

from .. import drawing, metrics
from ..workers.shares import WHOLE, Share

CHOSEN = "chosen"
"""Name of the policy that chooses the distance of each push."""
SHOWN = ("completion", "grasp_success_all", "efficiency_all")
"""Metrics of clearing that the table and the figure show."""


def parse(text: str) -> tuple[float, ...]:
    """Return the distances of `first:last:step`, in metres, both ends included.

    Raises:
      UserError: it is none.
    """
    try:
        first, last, step = (float(part) for part in text.split(":"))
        count = round((last - first) / step) + 1
        good = step > 0 and 1 <= count <= 100 and abs(first + (count - 1) * step - last) < 1e-6
    except (ValueError, ZeroDivisionError, OverflowError):
        good = False
    if not good:
        raise UserError(f"--distances {text}: want first:last:step in metres, such as 0.03:0.12:0.01")
    return tuple(round(first + i * step, 6) for i in range(count))


def name(distance: float) -> str:
    """Return how a distance is written in metric names, such as `0.03`."""
    return f"{distance:g}"


def measured(
    predictor: Predictor,
    engine: Engine,
    config: SceneConfig,
    distances: Sequence[float],
    *,
    scenes: int,
    seed: int,
    longest: float,
    share: Share = WHOLE,
) -> dict[str, np.ndarray]:
    """Measure 1-IoU of predicted masks after one push on each scene of this worker, the same pushes at every distance.

    Args:
      predictor: of `config.slots` objects.
      engine: the engine whose result counts as the truth, at rest and without the gripper.
      config: scenes.
      distances: `K` of them, metres.
      scenes: number of scenes of all workers.
      seed: random seed of scenes and pushes.
      longest: metres that are simulated, the same for all distances.
      share: which scenes this worker pushes on; every worker drops all of them.

    Returns:
      Of the scenes on which a push is feasible, `scene [B]`, their numbers, `error [B, K, 2]`, the sum of 1-IoU over
      objects in sight, and over those of them that move, and `count [B, K, 2]`, the numbers of these objects.
    """
    key, aim = jax.random.split(seeds.key(seed, seeds.Purpose.SWEEP_SCENES))
    items = clutter.settled_scenes(key, engine, config, scenes)
    mine = np.array(share.rows(scenes))
    items, keys = structs.take(items, mine), jax.random.split(aim, scenes)[mine]
    seen, pushes, feasible = batching.in_batches(_look, keys, items.scene, items.poses)
    rows = np.flatnonzero(feasible)
    seen, pushes = structs.take(seen, rows), structs.take(pushes, rows)
    scene, poses = structs.take(items.scene, rows), items.poses[rows]
    error, count = np.zeros((len(rows), len(distances), 2), np.float32), np.zeros((len(rows), len(distances), 2), int)
    with console.Progress("predict", len(distances) * len(rows), unit="pushes") as progress:
        for at, distance in enumerate(distances if len(rows) else ()):
            each = pushes.replace(distance=np.full(len(rows), distance, np.float32))
            rollout = primitives.push(engine, scene, poses, each, longest=longest)
            after = np.asarray(rollout.poses)[:, -1]
            measure = functools.partial(_errors, predictor=predictor)
            wrong, visible, moved = map(np.asarray, batching.in_batches(measure, seen, each, scene, poses, after))
            good = Fault.usable(rollout.fault)[:, None]
            for which, mask in enumerate((visible, moved)):
                error[:, at, which], count[:, at, which] = (wrong * (mask & good)).sum(1), (mask & good).sum(1)
            progress.advance(len(rows), f"{100 * distance:.0f} cm")
    return {"scene": mine[rows], "error": error, "count": count}


def error_rates(found: dict[str, np.ndarray], distances: Sequence[str]) -> dict[str, float]:
    """Return `sweep/DISTANCE/push_error/{all,moved}` with bootstrap 95 % intervals over scenes.

    Args:
      found: as `measured` returns it, of all workers.
      distances: the names of the distances.
    """
    values: dict[str, float] = {}
    for number, distance in enumerate(distances):
        for kind, which in enumerate(("all", "moved")):
            hits = metrics.ratio_interval(found["error"][:, number, kind], found["count"][:, number, kind])
            at = f"sweep/{distance}/push_error/{which}"
            values |= dict(zip((at, f"{at}_low", f"{at}_high"), hits, strict=True))
    return values


@jax.jit
def _look(keys: jax.Array, scene: Scene, poses: jax.Array) -> tuple[Observation, Push, jax.Array]:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Observation, Push, jax.Array]:
        seen = render.render(*args[1:])
        pushes, feasible = candidates.sample_pushes(args[0], seen, count=1, distance=0.1)
        return seen, jax.tree.map(lambda leaf: leaf[0], pushes), feasible[0]

    return jax.lax.map(one, (keys, scene, poses))


@functools.partial(jax.jit, static_argnames="predictor")
def _errors(
    seen: Observation, pushes: Push, scene: Scene, before: jax.Array, after: jax.Array, *, predictor: Predictor
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return 1-IoU `[B, N]` of predicted masks, which objects were in sight, and which of them moved."""

    def one(args: tuple[Observation, Push, Scene, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        seen, push, scene, before, after = args
        slots = before.shape[0]
        motion = predictor(seen, jax.tree.map(lambda leaf: leaf[None], push))[0]
        centers, area = masks.mask_centers(seen.label, slots)
        predicted = imagine.imagine(seen, centers, motion).label
        _, truth = render.render_depth(scene, after)
        error, _ = losses.mask_errors(predicted, truth, slots)
        true_motion = geometry.planar_motion(before, after, centers)
        return error, area > 0, (area > 0) & losses.moved(true_motion)

    return jax.lax.map(one, (seen, pushes, scene, before, after))


def names(values: dict[str, Any]) -> list[str]:
    """Return the names of what was swept, in order, the choosing policy last."""
    found = {key.split("/")[1] for key in values if key.startswith("sweep/")}
    return [*sorted(found - {CHOSEN}, key=float), *(found & {CHOSEN})]


def table(values: dict[str, Any]) -> str:
    """Return an HTML table of a sweep."""
    head = ["metres", "prediction error, moved", *[f"{key.replace('_', ' ')} %" for key in SHOWN], "pushes"]
    rows = []
    for each in names(values):
        at = f"sweep/{each}"
        error = values.get(f"{at}/push_error/moved")
        cells = [drawing.percent(values, f"{at}/{key}") for key in SHOWN]
        rows.append([each, "-" if error is None else f"{error:.3f}", *cells, str(values.get(f"{at}/pushes", "-"))])
    return pages.table(head, rows)


def figure(values: dict[str, Any]) -> Any:
    """Plot prediction error, completion, grasp success and efficiency against distance."""
    each = [one for one in names(values) if one != CHOSEN]
    x = [100 * float(one) for one in each]
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.2))
    panels = ("push_error/moved", *SHOWN)
    for axis, key in zip(axes, panels, strict=True):
        for i, which in enumerate(("", "_low", "_high")):
            y = [values.get(f"sweep/{one}/{key}{which}", np.nan) for one in each]
            axis.plot(x, np.array(y, float), color="C0", marker="." if i == 0 else "", alpha=1 if i == 0 else 0.3)
        if values.get(f"sweep/{CHOSEN}/{key}") is not None:
            axis.axhline(values[f"sweep/{CHOSEN}/{key}"], color="C1", label="distance chosen")
            axis.legend(fontsize=7)
        axis.set(xlabel="push distance, cm", title=key.replace("_", " ").replace("/", ", "))
        axis.grid(alpha=0.3)
    figure.tight_layout()
    return figure
