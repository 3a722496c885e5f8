"""An engine whose results for a scene do not depend, to the last bit, on the scenes simulated beside it."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from dipn_jax import structs
from dipn_jax.engine import Engine
from dipn_jax.structs import Array, Rollout, Scene, Trajectory


def group_by_object_count(engine: Engine) -> Engine:
    """Return an engine that simulates only scenes with equal numbers of objects together, if `engine` is `native`.

    `native` gives all scenes of a batch as many bodies as the fullest one has. A scene's unused bodies touch nothing,
    but they change the last digits of the solver's result. MJX has a body for every slot, and its results
    depend on no neighbour; in MuJoCo Warp scenes share their room for contacts, so there they may.
    """
    return Grouped(engine) if engine.name == "native" else engine


class Grouped:
    """An `Engine` that splits batches by number of objects and passes each part to another engine."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.name, self.config, self.batch = engine.name, engine.config, engine.batch

    def simulate(
        self,
        scenes: Scene,
        poses: Float[Array, "B N 7"],
        trajectories: Trajectory,
        samples: Float[Array, " S"],
        *,
        settle: bool = False,
        fence: float = 0.0,
    ) -> Rollout:
        """See `Engine.simulate`; takes arrays of any kind, returns NumPy arrays."""
        scenes, poses, trajectories = jax.tree.map(np.asarray, (scenes, poses, trajectories))
        counts = (scenes.shape >= 0).sum(-1)
        groups = [np.flatnonzero(counts == count) for count in np.unique(counts)]
        parts = [
            self._engine.simulate(
                structs.take(scenes, rows),
                poses[rows],
                structs.take(trajectories, rows),
                samples,
                settle=settle,
                fence=fence,
            )
            for rows in groups
        ]
        places = np.argsort(np.concatenate(groups))
        joined: Rollout = jax.tree.map(lambda *leaves: np.concatenate(leaves)[places], *parts)
        return joined

    def stop(self) -> None:
        """See `Engine.stop`."""
        self._engine.stop()
