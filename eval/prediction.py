"""How well is a push predicted? DIPN against nothing moves, only the pushed object moves, and the engine itself."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax import (
    candidates,
    clutter,
    console,
    geometry,
    imagine,
    losses,
    policy,
    primitives,
    render,
    shapes,
    structs,
)
from dipn_jax.physics import Engine
from dipn_jax.planner import Predictor
from dipn_jax.scenes import SceneConfig
from dipn_jax.structs import Fault, Observation, Push, Scene, SettledScene
from dipn_jax.workspace import PUSH_STEPS
from eval import resume

DISTANCES = (5, 10)
"""Centimetres at which errors are reported."""
FILMS = 6
"""Pushes kept as pictures."""


def evaluate(
    push_net: pathlib.Path,
    engine: Engine,
    config: SceneConfig,
    partial: resume.Partial,
    *,
    scenes: int,
    seed: int,
    physics: bool,
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Errors of every predictor on held-out scenes, one push each.

    Args:
      push_net: run of `dipn-train push`.
      engine: what truth is.
      config: scenes.
      partial: where an interrupted evaluation is kept.
      scenes: how many.
      seed: of the scenes and pushes.
      physics: also roll the engine out with nominal mass and friction.

    Returns:
      Flat metrics, and pictures `[4, ...]` of some pushes (before, predicted, after 10 cm).
    """
    slots = config.slots
    predictors: dict[str, Predictor] = {
        "dipn": policy.load_predictor(push_net, slots),
        "static": policy.static_predictor(slots),
        "trans": policy.trans_predictor(slots),
    }
    measure = {name: _measurer(predictor, slots) for name, predictor in predictors.items()}
    rows: dict[str, list[np.ndarray]] = {}
    films: list[dict[str, np.ndarray]] = []
    done, batch, rows, films = partial.load((0, 0, rows, films))
    with console.Progress("prediction", scenes, unit="pushes", done=done) as progress:
        while done < scenes:
            drop, aim = jax.random.split(jax.random.fold_in(jax.random.key(seed), batch))
            items = clutter.settled_exactly(drop, engine, config, min(clutter.BATCH, scenes - done))
            pushes, feasible = _one_push(jax.random.split(aim, len(items.fault)), items.scene, items.poses)
            items, pushes, truth, rolled = _execute(engine, items, pushes, np.asarray(feasible), physics)
            for i in range(len(pushes.angle)):
                scene, push = structs.take(items.scene, i), structs.take(pushes, i)
                for centimetres in DISTANCES:
                    push = push.replace(distance=np.float32(centimetres * 0.01))
                    arrays = (scene, push, truth[i, 0], truth[i, centimetres])
                    for name, function in measure.items():
                        _record(rows, name, centimetres, function(*arrays))
                    if rolled is not None:
                        errors = _measure_rollout(*arrays, rolled[i, centimetres], slots=slots)
                        _record(rows, "physics", centimetres, errors)
                if len(films) < FILMS:
                    films.append(_film(scene, push, truth[i], predictors["dipn"], slots))
                progress.advance(1)
            done, batch = done + len(pushes.angle), batch + 1
            partial.save((done, batch, rows, films))
    names = [*measure, *(["physics"] if physics else [])]
    return _summary(rows, names), {k: np.stack([film[k] for film in films]) for k in films[0]}


def _execute(
    engine: Engine, items: SettledScene, pushes: Push, feasible: np.ndarray, physics: bool
) -> tuple[SettledScene, Push, np.ndarray, np.ndarray | None]:
    """The feasible pushes whose simulation went well, what they did `[B, 12, N, 7]`, and what nominal ones did."""
    items, pushes = structs.take(items, feasible), structs.take(pushes, feasible)
    if not feasible.any():
        return items, pushes, np.zeros((0,)), None
    result = primitives.push(engine, items.scene, items.poses, pushes)
    good = (np.asarray(result.fault) & Fault.UNUSABLE) == 0
    rolled = None
    if physics:
        rolled = np.asarray(primitives.push(engine, _nominal(items.scene), items.poses, pushes).poses)[good]
    return structs.take(items, good), structs.take(pushes, good), np.asarray(result.poses)[good], rolled


@jax.jit
def _one_push(keys: jax.Array, scene: Scene, poses: jax.Array) -> tuple[Push, jax.Array]:
    def one(args: tuple[jax.Array, Scene, jax.Array]) -> tuple[Push, jax.Array]:
        key, one_scene, one_poses = args
        seen = render.render(one_scene, one_poses)
        slots = one_scene.shape.shape[0]
        pushes, feasible = candidates.sample_pushes(key, seen, count=1, slots=slots, distance=PUSH_STEPS * 0.01)
        return jax.tree.map(lambda leaf: leaf[0], pushes), feasible[0]

    return jax.lax.map(one, (keys, jax.tree.map(jnp.asarray, scene), jnp.asarray(poses)))


def _errors(seen: Observation, motion: jax.Array, centers: jax.Array, true_label: jax.Array, slots: int) -> Any:
    predicted = imagine.imagine(seen, centers, motion)
    return losses.mask_errors(predicted.label, true_label, slots)


def _measurer(predictor: Predictor, slots: int) -> Callable[..., dict[str, jax.Array]]:
    """A jitted (scene, push, pose before, pose after) -> errors of every object."""

    @jax.jit
    def measure(scene: Scene, push: Push, before: jax.Array, after: jax.Array) -> dict[str, jax.Array]:
        seen = render.render(scene, before)
        motion = predictor(seen, jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], push))[0]
        return _compare(scene, seen, motion, before, after, slots)

    return measure


@functools.partial(jax.jit, static_argnames="slots")
def _measure_rollout(
    scene: Scene, push: Push, before: jax.Array, after: jax.Array, rolled: jax.Array, *, slots: int
) -> dict[str, jax.Array]:
    seen = render.render(scene, before)
    centers, _ = candidates.mask_centers(seen.label, slots)
    return _compare(scene, seen, geometry.planar_motion(before, rolled, centers), before, after, slots)


def _compare(
    scene: Scene, seen: Observation, motion: jax.Array, before: jax.Array, after: jax.Array, slots: int
) -> dict[str, jax.Array]:
    centers, area = candidates.mask_centers(seen.label, slots)
    _, true_label = render.render_depth(scene, after)
    true_motion = geometry.planar_motion(before, after, centers)
    iou, xor = _errors(seen, motion, centers, true_label, slots)
    shift = jnp.linalg.norm((motion - true_motion)[:, :2], axis=-1) * 1000
    turn = jnp.abs(geometry.wrap_angle((motion - true_motion)[:, 2])) * 180 / jnp.pi
    return {
        "one_minus_iou": iou,
        "paper": xor,
        "position_mm": shift,
        "angle_deg": turn,
        "visible": area > 0,
        "moved": losses.moved(true_motion) & (area > 0),
    }


def _record(rows: dict[str, list[np.ndarray]], name: str, centimetres: int, values: dict[str, jax.Array]) -> None:
    for key, value in values.items():
        rows.setdefault(f"{name}/{centimetres}cm/{key}", []).append(np.asarray(value))


def _summary(rows: dict[str, list[np.ndarray]], names: list[str]) -> dict[str, float]:
    metrics: dict[str, float] = {}
    for name in names:
        for centimetres in DISTANCES:
            at = f"{name}/{centimetres}cm"
            visible, moved = np.concatenate(rows[f"{at}/visible"]), np.concatenate(rows[f"{at}/moved"])
            for title, key in (("push_error", "one_minus_iou"), ("push_error_paper_measure", "paper")):
                values = np.concatenate(rows[f"{at}/{key}"])
                metrics[f"{title}/{at}/all"] = float(values[visible].mean())
                metrics[f"{title}/{at}/moved"] = float(values[moved].mean()) if moved.any() else float("nan")
            for key in ("position_mm", "angle_deg"):
                values = np.concatenate(rows[f"{at}/{key}"])[moved]
                metrics[f"push_{key}/{at}/moved"] = float(values.mean()) if moved.any() else float("nan")
            metrics[f"objects_moved/{centimetres}cm"] = int(moved.sum())
    metrics["objects"] = int(visible.sum())
    metrics["pushes"] = len(rows[f"{names[0]}/{DISTANCES[0]}cm/visible"])
    return metrics


def _nominal(scene: Scene) -> Scene:
    """The scene as one who sees only shapes would guess it: density 500 kg/m^3, friction 0.35."""
    shape = np.asarray(scene.shape)
    mass = np.where(shape >= 0, 500.0 * shapes.volume(shape, np.asarray(scene.size)), 0.1)
    return scene.replace(mass=mass.astype(np.float32), friction=np.full(shape.shape, 0.35, np.float32))


def _film(scene: Scene, push: Push, truth: np.ndarray, predictor: Predictor, slots: int) -> dict[str, np.ndarray]:
    seen = render.render(scene, truth[0])
    centers, _ = candidates.mask_centers(seen.label, slots)
    motion = predictor(seen, jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], push))[0]
    after = render.render(scene, truth[PUSH_STEPS])
    return {
        "before": np.asarray(seen.color),
        "predicted": np.asarray(imagine.imagine(seen, centers, motion).color),
        "after": np.asarray(after.color),
        "push": np.array([*np.asarray(push.start), push.angle, push.distance], np.float32),
    }
