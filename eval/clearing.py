"""Clear tables with Alg. 2, many instances in lockstep, to the end rules of the paper."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import jax
import numpy as np

from dipn_jax import candidates, clutter, console, files, planner, policy, primitives, render, resume, structs
from dipn_jax.errors import UserError
from dipn_jax.physics import Engine
from dipn_jax.structs import Decision, Fault, Observation, Push, Scene
from dipn_jax.workspace import WORKSPACE
from eval import film, metrics
from eval.instances import Instance

ACTIONS_PER_OBJECT = 3
"""Source: the paper; more actions than that is a failure."""


@dataclasses.dataclass(frozen=True)
class ClearConfig:
    """How to decide."""

    method: str = "dipn+gn"  # or gn: grasps only
    candidates: int = 32
    distance: float = 0.10  # metres a push goes, and is predicted for
    gamma: float = 0.9
    threshold: float = 0.7


def clear(
    instances: list[Instance],
    engine: Engine,
    predictor: planner.Predictor,
    scorer: planner.Scorer,
    config: ClearConfig,
    partial: resume.Partial,
    *,
    seed: int,
) -> list[Instance]:
    """Act on every instance until all have ended.

    Args:
      instances: settled tables; changed in place, or replaced by those of an interrupted evaluation.
      engine: physics.
      predictor: where everything goes.
      scorer: which grasps hold.
      config: the rule.
      partial: where an interrupted evaluation is kept.
      seed: of the push candidates.

    Returns:
      The instances, ended.
    """
    if config.method not in ("dipn+gn", "gn"):
        raise UserError(f"--method {config.method}: want dipn+gn or gn")
    total = sum(instance.objects for instance in instances)
    turn, instances = partial.load((0, instances))
    with console.Progress("clear", total, unit="objects", done=sum(i.removed for i in instances)) as progress:
        while active := [instance for instance in instances if not instance.ended]:
            before = sum(instance.removed for instance in instances)
            was = [(instance.scene.shape, instance.poses) for instance in active]
            step = jax.random.fold_in(jax.random.key(seed), turn)
            decisions = [
                _decide(jax.random.fold_in(step, i), instance, predictor, scorer, config)
                for i, instance in enumerate(active)
            ]
            pushing = [(a, s, d) for a, (s, d) in zip(active, decisions, strict=True) if bool(d.is_push)]
            grasping = [(a, s, d) for a, (s, d) in zip(active, decisions, strict=True) if not bool(d.is_push)]
            if pushing:
                _push(pushing, engine)
            if grasping:
                _grasp(grasping, engine)
            for instance, state, (_, decision) in zip(active, was, decisions, strict=True):
                _remember(instance, state, decision)
                instance.ended = instance.ended or _ended(instance)
            turn += 1
            partial.save((turn, instances))
            removed = sum(instance.removed for instance in instances) - before
            done = len(instances) - sum(not instance.ended for instance in instances)
            progress.advance(removed, f"{done}/{len(instances)} tables ended")
    return instances


def _decide(
    key: jax.Array, instance: Instance, predictor: planner.Predictor, scorer: planner.Scorer, config: ClearConfig
) -> tuple[Observation, Decision]:
    seen = render.render(instance.scene, instance.poses)
    decision = planner.decide(
        key,
        seen,
        predictor,
        scorer,
        count=config.candidates,
        slots=len(instance.scene.shape),
        distance=config.distance,
        gamma=config.gamma,
        threshold=config.threshold if config.method == "dipn+gn" else -1.0,
    )
    return seen, jax.device_get(decision)


Acting = list[tuple[Instance, Observation, Decision]]


def _stack(rows: Acting) -> tuple[Scene, np.ndarray]:
    scene = jax.tree.map(lambda *leaves: np.stack(leaves), *[instance.scene for instance, _, _ in rows])
    return scene, np.stack([instance.poses for instance, _, _ in rows])


def _push(rows: Acting, engine: Engine) -> None:
    scene, poses = _stack(rows)
    pushes: Push = jax.tree.map(lambda *leaves: np.stack(leaves), *[decision.push for _, _, decision in rows])
    rollout = primitives.push(engine, scene, poses, pushes)
    wrong = ~Fault.usable(rollout.fault)
    for i, (instance, _, _) in enumerate(rows):
        instance.pushes += 1
        instance.ended = "fault" if wrong[i] else ""
        instance.poses = np.asarray(rollout.poses)[i, -1]
        instance.did.append("push")


def _grasp(rows: Acting, engine: Engine) -> None:
    scene, poses = _stack(rows)
    taken = [candidates.grasp_at(decision.grasp_pixel, seen.height) for _, seen, decision in rows]
    grasps = jax.tree.map(lambda *leaves: np.stack(leaves), *taken)
    scene, rested, held, fault = clutter.grasp_away(engine, scene, poses, grasps)
    wrong = ~Fault.usable(fault)
    for i, (instance, _, _) in enumerate(rows):
        instance.grasps += 1
        instance.held += bool(held[i].any())
        instance.ended = "fault" if wrong[i] else ""
        instance.removed += int(held[i].sum())
        instance.scene, instance.poses = structs.take(scene, i), rested[i]
        instance.did.append("grasp held" if held[i].any() else "grasp missed")


def _remember(instance: Instance, state: tuple[np.ndarray, np.ndarray], decision: Decision) -> None:
    """Keep what a frame can be drawn from again: where everything was, and what was decided."""
    push = decision.push
    instance.film.append(
        {
            "shape": state[0],
            "poses": state[1],
            "push": np.array([*push.start, push.angle, push.distance], np.float32),
            "grasp": np.asarray(decision.grasp_pixel),
            "values": np.array([decision.grasp_score, decision.value_now, decision.value_push], np.float32),
            "motion": np.asarray(decision.motion, np.float32),
        }
    )


def _ended(instance: Instance) -> str:
    present = instance.scene.shape >= 0
    if (np.abs(instance.poses[present, :2]) > WORKSPACE.half).any():
        return "pushed out"
    if not present.any():
        return "cleared"
    return "out of actions" if instance.actions >= ACTIONS_PER_OBJECT * instance.objects else ""


def summary(instances: list[Instance]) -> dict[str, Any]:
    """Flat metrics, each with a bootstrap 95 % interval over instances (`_low`, `_high`).

    As in the paper: completion is instances cleared over instances, grasp success is objects grasped over grasp
    actions, efficiency is objects removed over all actions; the last two over all instances and over completed ones,
    summed before they are divided. A grasp may lift two objects, so `grasps_that_held` stands beside.
    """
    done = np.array([instance.ended == "cleared" for instance in instances])
    removed = np.array([instance.removed for instance in instances])
    held = np.array([instance.held for instance in instances])
    grasps = np.array([instance.grasps for instance in instances])
    actions = np.array([instance.actions for instance in instances])
    rows = {
        "completion": (done, np.ones(len(done))),
        "grasp_success_all": (removed, grasps),
        "grasp_success_completed": (removed * done, grasps * done),
        "grasps_that_held": (held, grasps),
        "efficiency_all": (removed, actions),
        "efficiency_completed": (removed * done, actions * done),
    }
    result: dict[str, Any] = {}
    for name, (hits, trials) in rows.items():
        value, low, high = metrics.ratio_interval(hits, trials)
        result |= {name: value, f"{name}_low": low, f"{name}_high": high}
    result |= {"instances": len(instances), "grasps": int(grasps.sum()), "pushes": int((actions - grasps).sum())}
    for reason in ("cleared", "pushed out", "out of actions", "fault"):
        result[f"ended_{reason.replace(' ', '_')}"] = sum(instance.ended == reason for instance in instances)
    return result


def save(instances: list[Instance], out: pathlib.Path) -> None:
    """Every step of every instance, as `episodes/NUMBER.npz` (see `eval.film`), and a list of them, `episodes.json`."""
    lines = []
    for number, instance in enumerate(instances):
        stem = f"{number:03d}"
        film.save(out / "episodes" / f"{stem}.npz", instance)
        lines.append(
            {
                "name": instance.name,
                "file": f"episodes/{stem}.npz",
                "ended": instance.ended,
                "objects": instance.objects,
                "removed": instance.removed,
                "grasps": instance.grasps,
                "pushes": instance.pushes,
            }
        )
    files.write_json(out / "episodes.json", lines)


def load_policies(config: ClearConfig, push_net: pathlib.Path | None, grasp_net: pathlib.Path, slots: int) -> Any:
    """Predictor and scorer for a method.

    Raises:
      UserError: the method needs a push network and none was given.
    """
    if config.method == "gn":
        return policy.static_predictor(slots), policy.load_scorer(grasp_net)
    if push_net is None:
        raise UserError(f"--method {config.method}: wants --push-net; give a run of dipn-train push")
    return policy.load_predictor(push_net, slots), policy.load_scorer(grasp_net)
