"""Simulate episodes again from their records, and measure how far they end from what is stored."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import numpy as np

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.physics import make_engine
from dipn_jax.storage import codec, records, shards
from dipn_jax.structs import Fault, PushEpisode
from dipn_jax.system import machine
from dipn_jax.workspace import PUSH_STEPS
from dipn_jax.world import primitives


@dataclasses.dataclass(frozen=True)
class Set:
    """A data set of pushes or grasps, read whole."""

    folder: pathlib.Path
    kind: str
    config: dict[str, Any]  # with which it was made
    episodes: Any  # [B]
    old_shards: int  # that do not hold the exact start of their episodes
    instructions: tuple[str, ...] = ()  # instruction sets that it was made with, other than that of this processor

    def everything(self) -> np.ndarray:
        """Return the numbers of all episodes."""
        return np.arange(len(self.episodes.fault))

    def draw(self, count: int, seed: int) -> np.ndarray:
        """Return the numbers of `count` episodes (of all, if there are fewer) drawn at random, in order."""
        total = len(self.episodes.fault)
        return np.sort(np.random.default_rng(seed).choice(total, min(count, total), replace=False))

    def chosen(self, given: tuple[str, ...]) -> np.ndarray:
        """Return the numbers that a user gave: single ones, and ranges such as 5:8.

        Raises:
          UserError: one is no number, or there is no such episode.
        """
        total = len(self.episodes.fault)
        found: list[int] = []
        for word in given:
            first, colon, end = word.partition(":")
            if not (first.isdecimal() and (end.isdecimal() or not colon)):
                raise UserError(f"replay {word}: want the number of an episode, such as 5, or a range, such as 5:8")
            numbers = range(int(first), int(end) if colon else int(first) + 1)
            if not numbers or numbers[-1] >= total:
                raise UserError(f"replay {word}: no such episode in {self.folder}, which has 0 to {total - 1}")
            found += numbers
        return np.array(found)

    def engine(self, name: EngineName | None, timestep: float | None, threads: int | None) -> Engine:
        """Return the engine called `name`, or the engine and time step that made the data set."""
        if name is None and timestep is None:
            timestep = self.config.get("timestep")
        return make_engine(name or self.config.get("engine", "auto"), timestep=timestep, threads=threads)


@dataclasses.dataclass(frozen=True)
class Difference:
    """How far a simulated episode is from the stored one."""

    apart: float  # metres: largest distance of an object from where it is stored
    turned: float  # radians: largest turn of an object from how it is stored
    component: float  # largest difference of a number: metres, or a component of a quaternion
    said: str  # whether flags are as stored, in words; empty if the episode has come out otherwise only in poses

    def beyond(self, tolerance: float) -> bool:
        """Return whether the episode differs from what is stored; a pose that is not finite differs, too."""
        return bool(self.said) or not self.component <= tolerance


def open_set(folder: pathlib.Path) -> Set:
    """Read a data set of pushes or grasps.

    Raises:
      UserError: there is none, it is damaged, or its episodes have no action to simulate.
    """
    about = records.summary(folder)
    kind = str(about["kind"])
    if kind == "images":
        raise UserError(
            f"data set {folder}: settled scenes without an action, so there is nothing to simulate; give a set of "
            "pushes or grasps"
        )
    episodes, _ = records.load(folder, kind=kind)
    paths = sorted(folder.glob("shard-*.parquet"))
    metas = [shards.read_meta(path) for path in paths]
    ways = {(str(meta["config"].get("engine")), meta["config"].get("timestep")) for meta in metas}
    if len(ways) > 1:
        named = sorted(f"{engine} at {f'{step} s' if step else 'its own step'}" for engine, step in ways)
        raise UserError(
            f"data set {folder}: merged from sets that were simulated differently ({', '.join(named)}); replay each of "
            "them by itself"
        )
    old = sum(meta.get("start") != shards.ROUNDED_START for meta in metas)
    others = {str(meta.get("instructions", machine.instructions())) for meta in metas} - {machine.instructions()}
    return Set(folder, kind, about["config"], episodes, old, tuple(sorted(others)))


def replayed(episodes: Any, engine: Engine) -> Any:
    """Return episodes `[B]` of pushes or grasps simulated again."""
    if isinstance(episodes, PushEpisode):
        start = episodes.poses[:, 0]
        rollout = primitives.push(engine, episodes.scene, start, episodes.push)
        poses = np.array(rollout.poses)
        poses[:, 0] = start
        fault = np.asarray(rollout.fault)
        return episodes.replace(poses=poses[:, : PUSH_STEPS + 1], after=poses[:, -1], fault=fault)
    rollout, outcome = primitives.grasp(engine, episodes.scene, episodes.poses, episodes.grasp)
    return episodes.replace(
        after=np.asarray(rollout.poses)[:, -1],
        held=np.asarray(outcome.held),
        success=np.asarray(outcome.success),
        fault=np.asarray(rollout.fault),
    )


def difference(stored: Any, again: Any) -> Difference:
    """Return how far one simulated episode is from the stored one, over the objects on its table."""
    there = np.asarray(stored.scene.shape) >= 0
    names = ("poses", "after") if isinstance(stored, PushEpisode) else ("after",)
    old, new = (
        np.concatenate([np.asarray(getattr(each, name), float).reshape(-1, *there.shape, 7) for name in names])[
            :, there
        ]
        for each in (stored, again)
    )
    same_side = np.where((old[..., 3:] * new[..., 3:]).sum(-1, keepdims=True) < 0, -1, 1)  # -q is the same turn as q
    new = np.concatenate([new[..., :3], same_side * new[..., 3:]], -1)
    chord = np.linalg.norm(old[..., 3:] - new[..., 3:], axis=-1)
    return Difference(
        apart=np.linalg.norm(old[..., :3] - new[..., :3], axis=-1).max(initial=0.0),
        turned=float(4 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)).max(initial=0.0)),
        component=np.abs(old - new).max(initial=0.0),
        said="; ".join(_flags(stored, again)),
    )


def _flags(stored: Any, again: Any) -> list[str]:
    """Return in words which held objects and faults differ from what is stored."""
    found = []
    if not isinstance(stored, PushEpisode) and (stored.held != again.held).any():
        slots = [", ".join(map(str, np.flatnonzero(each.held))) or "nothing" for each in (stored, again)]
        found.append(f"held {slots[1]}, stored {slots[0]}")
    if stored.fault != again.fault:
        names = [[name for bit, name in Fault.NAMES.items() if int(each.fault) & bit] for each in (stored, again)]
        found.append("faults {1}, stored {0}".format(*(" ".join(each) or "none" for each in names)))
    return found


def report(data: Set, chosen: np.ndarray, engine: Engine, tolerance: float | None) -> int:
    """Replay the `chosen` episodes, print how far each is from what is stored, and a summary.

    Args:
      data: where they are from.
      chosen: their numbers.
      engine: physics.
      tolerance: see `Difference.component`; that of the storage if None.

    Returns:
      1 if an episode differs, else 0.
    """
    tolerance = codec.QUANTA["poses"] if tolerance is None else tolerance
    if data.old_shards:
        console.warn(
            f"{data.folder}: {data.old_shards} shards are older than exact replay: their episodes began within half a "
            "micrometre of what is stored, which contact makes millimetres of"
        )
    if data.instructions:
        console.warn(
            f"{data.folder}: made with {', '.join(data.instructions)}, replayed with {machine.instructions()}: other "
            "instruction sets change the last digits, which contact makes more of"
        )
    found: list[Difference] = []
    with console.Progress("replay", len(chosen), unit="episodes") as progress:
        for start in range(0, len(chosen), engine.batch):
            some = structs.take(data.episodes, chosen[start : start + engine.batch])
            again = replayed(some, engine)
            found += [difference(some[i], again[i]) for i in range(len(some.fault))]
            progress.advance(len(some.fault))
    for number, one in zip(chosen, found, strict=True):
        as_stored = "" if data.kind == "push" or one.said.startswith("held") else ", held as stored"
        console.say(f"{number}: {_size(one.apart, one.turned)}{as_stored}{'; ' * bool(one.said)}{one.said}")
    wrong = sum(one.beyond(tolerance) for one in found)
    largest = _size(max(one.apart for one in found), max(one.turned for one in found))
    outcome = f"{wrong} of {len(found)} differ by more than" if wrong else f"all {len(found)} are as stored, within"
    console.say(f"{data.folder}: {outcome} {tolerance:g}; largest difference {largest}")
    return int(wrong > 0)


def _size(apart: float, turned: float) -> str:
    """Return a distance (metres) and a turn (radians) in words."""
    return f"{1000 * apart:.4f} mm, {np.rad2deg(turned):.4f} degrees"
