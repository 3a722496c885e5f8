"""Clear many tables in lockstep, by the end rules of the paper."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dipn_jax import seeds, structs
from dipn_jax.commands import console
from dipn_jax.engine import Engine
from dipn_jax.storage import resume
from dipn_jax.structs import Array, Decision, Fault
from dipn_jax.system import files
from dipn_jax.workspace import PUSH_STEPS, WORKSPACE
from dipn_jax.world import clutter, primitives

from .. import metrics
from . import film
from .instances import Instance
from .on_tables import TablePolicy

EPISODES = "episodes.json"
"""Name of the file that lists the tables of an evaluation."""
ACTIONS_PER_OBJECT = 3
"""Most actions per object; a table that needs more is not cleared. Source: the paper."""


def clear(
    instances: list[Instance],
    engine: Engine,
    decide: TablePolicy,
    partial: resume.Partial,
    *,
    seed: int,
    longest: float = PUSH_STEPS * 0.01,
    remember: bool = True,
) -> list[Instance]:
    """Act on every instance until all have ended; those that have not ended are decided on and simulated together.

    What happens on one table does not depend on the others.

    Args:
      instances: settled tables; changed in place, or replaced by those of an interrupted evaluation.
      engine: physics engine.
      decide: the policy.
      partial: where an interrupted evaluation is kept.
      seed: random seed of the push candidates.
      longest: metres of the longest push that `decide` asks for.
      remember: give `decide` the grasps that missed, as long as the table looks the same around them.

    Returns:
      The instances, ended.
    """
    total = sum(instance.objects for instance in instances)
    instances = partial.load(instances)
    with console.Progress("clear", total, unit="objects", done=sum(i.removed for i in instances)) as progress:
        while active := [number for number, instance in enumerate(instances) if not instance.ended]:
            rows = [instances[number] for number in active]
            before = sum(instance.removed for instance in instances)
            scene, poses = structs.stack([row.scene for row in rows]), np.stack([row.poses for row in rows])
            now = jnp.stack([action_key(seed, row.number, row.actions) for row in rows])
            decision, seen = decide(now, scene, poses, functools.partial(_recall, rows))
            for is_push, act in ((True, functools.partial(_push, longest=longest)), (False, _grasp)):
                which = np.flatnonzero(decision.is_push == is_push)
                if len(which):
                    act([rows[i] for i in which], decision[which], engine)
            for i, instance in enumerate(rows):
                _record(instance, np.asarray(scene.shape[i]), poses[i], decision[i], np.asarray(seen.label[i]))
                if remember and instance.did[-1] == "grasp missed":
                    instance.missed = instance.missed.add(decision.grasp_pixel[i], seen.height[i])
                instance.ended = instance.ended or _ended(instance)
            partial.save(instances)
            removed = sum(instance.removed for instance in instances) - before
            done = sum(bool(instance.ended) for instance in instances)
            progress.advance(removed, f"{done}/{len(instances)} tables ended")
    return instances


def action_key(seed: int, number: int, action: int) -> jax.Array:
    """Return the random key of one action on the table of a `number`: of the noise of its image, and of candidates."""
    return jax.random.fold_in(jax.random.fold_in(seeds.key(seed, seeds.Purpose.CLEARING_CANDIDATES), number), action)


def _push(rows: list[Instance], decision: Decision, engine: Engine, *, longest: float) -> None:
    scene, poses = structs.stack([row.scene for row in rows]), np.stack([row.poses for row in rows])
    rollout = primitives.push(engine, scene, poses, decision.push, longest=longest)
    wrong = ~Fault.usable(rollout.fault)
    for i, instance in enumerate(rows):
        instance.pushes += 1
        instance.ended = "fault" if wrong[i] else ""
        instance.poses = np.asarray(rollout.poses)[i, -1]
        instance.did.append("push")


def _grasp(rows: list[Instance], decision: Decision, engine: Engine) -> None:
    scene, poses = structs.stack([row.scene for row in rows]), np.stack([row.poses for row in rows])
    scene, rested, held, fault = clutter.grasp_away(engine, scene, poses, decision.grasp)
    wrong = ~Fault.usable(fault)
    for i, instance in enumerate(rows):
        instance.grasps += 1
        instance.held += bool(held[i].any())
        instance.ended = "fault" if wrong[i] else ""
        instance.removed += int(held[i].sum())
        instance.scene, instance.poses = structs.take(scene, i), rested[i]
        instance.did.append("grasp held" if held[i].any() else "grasp missed")


def _recall(rows: list[Instance], heights: Float[Array, "B H W"]) -> Int[np.ndarray, "B M 3"]:
    """Forget misses around which the tables look changed, and return those that remain."""
    for instance, height in zip(rows, heights, strict=True):
        instance.missed = instance.missed.recall(height)
    return np.stack([instance.missed.pixels() for instance in rows])


def _record(instance: Instance, shape: np.ndarray, poses: np.ndarray, decision: Decision, label: np.ndarray) -> None:
    """Record what an episode's pictures can be made from: the poses before the action, what was known, the decision."""
    push = decision.push
    instance.film.append(
        {
            "shape": shape,
            "poses": poses,
            "push": np.array([*push.start, push.angle, push.distance], np.float32),
            "grasp": np.asarray(decision.grasp_pixel),
            "values": np.array([decision.grasp_score, decision.value_now, decision.value_push], np.float32),
            "motion": np.asarray(decision.motion, np.float32),
            "label": film.packed(label),
            "missed": instance.missed.pixels(),
        }
    )


def _ended(instance: Instance) -> str:
    present = instance.scene.shape >= 0
    if (np.abs(instance.poses[present, :2]) > WORKSPACE.half).any():
        return "pushed out"
    if not present.any():
        return "cleared"
    return "out of actions" if instance.actions >= ACTIONS_PER_OBJECT * instance.objects else ""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What is counted of a table that has ended; an Instance has the same fields."""

    name: str
    ended: str
    objects: int
    removed: int
    held: int
    grasps: int
    pushes: int


def counts(tables: Sequence[Outcome] | Sequence[Instance]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return hits and trials of each table `[I]` by measure; a measure is the sum of its hits over that of its trials.

    `grasp_success` counts objects and may pass 1, because a grasp may lift two; `grasps_that_held` counts grasps.
    """
    done = np.array([table.ended == "cleared" for table in tables])
    removed, held, grasps, pushes = (
        np.array([getattr(table, name) for table in tables]) for name in ("removed", "held", "grasps", "pushes")
    )
    actions = grasps + pushes
    return {
        "completion": (done, np.ones(len(done))),
        "grasp_success_all": (removed, grasps),
        "grasp_success_completed": (removed * done, grasps * done),
        "grasps_that_held": (held, grasps),
        "efficiency_all": (removed, actions),
        "efficiency_completed": (removed * done, actions * done),
    }


def summary(instances: Sequence[Outcome] | Sequence[Instance]) -> dict[str, Any]:
    """Return flat metrics, each with a bootstrap 95 % interval over cases, then their repeats (`_low`, `_high`).

    As in the paper: completion is instances cleared over instances, grasp success is objects grasped over grasp
    actions, efficiency is objects removed over all actions; the last two over all instances and over completed ones,
    summed before they are divided. A grasp may lift two objects, so `grasps_that_held` stands beside.
    """
    rows = counts(instances)
    cases = [instance.name for instance in instances]
    result: dict[str, Any] = {}
    for name, (hits, trials) in rows.items():
        value, low, high = metrics.ratio_interval(hits, trials, groups=cases)
        result |= {name: value, f"{name}_low": low, f"{name}_high": high}
    grasps, pushes = (sum(getattr(instance, kind) for instance in instances) for kind in ("grasps", "pushes"))
    result |= {"instances": len(instances), "grasps": grasps, "pushes": pushes}
    for reason in ("cleared", "pushed out", "out of actions", "fault"):
        result[f"ended_{reason.replace(' ', '_')}"] = sum(instance.ended == reason for instance in instances)
    return result


def save(instances: list[Instance], out: pathlib.Path, *, numbers: Sequence[int] | None = None) -> list[str]:
    """Write every step of every instance to `episodes/NUMBER.npz` (see `eval.film`), and `episodes.json`, their list.

    Args:
      instances: tables that have ended.
      out: folder of the results.
      numbers: of these tables among all that are cleared; 0, 1, ... if not given.

    Returns:
      The names of the files.
    """
    lines: list[dict[str, Any]] = []
    for number, instance in zip(numbers or range(len(instances)), instances, strict=True):
        name = f"episodes/{number:03d}.npz"
        film.save(out / name, instance)
        lines.append(
            {
                "name": instance.name,
                "file": name,
                "ended": instance.ended,
                "objects": instance.objects,
                "removed": instance.removed,
                "held": instance.held,
                "grasps": instance.grasps,
                "pushes": instance.pushes,
            }
        )
    files.write_json(out / EPISODES, lines)
    return [EPISODES, *(line["file"] for line in lines)]
