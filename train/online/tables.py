"""Tables that a learner acts on side by side; a table that is finished is replaced by a fresh one."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Float

from dipn_jax import seeds, structs
from dipn_jax.engine import Engine
from dipn_jax.seeds import Purpose
from dipn_jax.storage import serialization
from dipn_jax.structs import Scene, SettledScene
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import clutter
from dipn_jax.world.scenes import SceneConfig

IDLE_LIMIT = 3
"""Actions without effect in a row after which a table is replaced."""


@serialization.register
@dataclasses.dataclass
class Tables:
    """T tables, with everything about them that an interrupted run has to keep."""

    scene: Scene  # [T, N], numpy
    poses: Float[np.ndarray, "T N 7"]
    spare: SettledScene  # tables that replace others later
    seed: int
    purpose: int  # a `seeds.Purpose`
    drawn: int = 1  # batches of tables that were drawn
    idle: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))  # [T] actions without effect

    def step(
        self, scene: Scene, poses: np.ndarray, effect: np.ndarray, good: np.ndarray, engine: Engine, config: SceneConfig
    ) -> np.ndarray:
        """Continue after an action; tables that are faulty, empty, spilt or stuck are replaced by fresh ones.

        Args:
          scene: `[T, N]` afterwards.
          poses: `[T, N, 7]` afterwards.
          effect: `[T]` bool: the action did something.
          good: `[T]` bool: its simulation went without a fault.
          engine: physics, for more tables.
          config: what tables are made of.

        Returns:
          Which tables were replaced `[T]` bool.
        """
        idle = np.where(effect, 0, self.idle + 1)
        outside = ((np.abs(poses[..., :2]) > WORKSPACE.half).any(-1) & (scene.shape >= 0)).any(1)
        again = ~good | outside | (idle >= IDLE_LIMIT) | ~(scene.shape >= 0).any(1)
        over = np.flatnonzero(again)
        while len(self.spare.fault) < len(over):
            more = _draw(engine, config, seeds.key(self.seed, Purpose(self.purpose)), self.drawn, len(good))
            self.spare = structs.concatenate([self.spare, more])
            self.drawn += 1
        fresh, self.spare = (structs.take(self.spare, part) for part in (slice(0, len(over)), slice(len(over), None)))
        self.poses = _replaced(over, poses, np.asarray(fresh.poses))
        self.scene = jax.tree.map(functools.partial(_replaced, over), scene, fresh.scene)
        self.idle = np.where(again, 0, idle)
        return again


def begin(engine: Engine, config: SceneConfig, *, count: int, seed: int, purpose: Purpose) -> Tables:
    """Return `count` fresh tables."""
    drawn = _draw(engine, config, seeds.key(seed, purpose), 0, count)
    first, spare = structs.take(drawn, slice(0, count)), structs.take(drawn, slice(count, None))
    return Tables(first.scene, np.asarray(first.poses), spare, seed, purpose, idle=np.zeros(count, int))


def _draw(engine: Engine, config: SceneConfig, key: jax.Array, batch: int, count: int) -> SettledScene:
    """Draw `2 * count` tables: twice the number that is acted on."""
    return clutter.settled_scenes(jax.random.fold_in(key, batch), engine, config, 2 * count)


def _replaced(where: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return `old` with its rows `where` replaced by `new`."""
    result = np.array(old)
    result[where] = new
    return result
