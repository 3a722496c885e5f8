"""What a physics engine is: its settings, and the one call that simulates a batch of scenes.

The engines themselves are in `dipn_jax.physics`; a function that simulates takes one of them as an argument.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float

from dipn_jax.structs import Array, Rollout, Scene, Trajectory


@dataclasses.dataclass(frozen=True)
class PhysicsConfig:
    """Solver settings, chosen by measurement; MuJoCo's documentation explains each option."""

    timestep: float = 0.002  # seconds
    falling_timestep: float = 0.0  # seconds of a step while objects are dropped (0: as `timestep`); `native` only
    iterations: int = 50
    ls_iterations: int = 50
    tolerance: float = 1e-8  # MuJoCo Warp, in float32, takes 1e-6 instead of anything smaller
    impratio: float = 10.0  # halves the slip of a lifted object
    cone: str = "elliptic"  # or pyramidal
    solref: str = "0.01 1"  # softer makes grasps wrong
    solimp: str = "0.95 0.99 0.001"
    sleep: float = 0.0  # m/s below which resting objects are left out of steps until they are touched (0: never)
    geom_pairs: tuple[int, int] | None = None  # MJX: pairs kept by the broad phase: at least, and per object
    contact_points: tuple[int, int] | None = None  # MJX: contacts kept: at least, and per object (None: all)
    solver: Literal["xla", "warp"] = "xla"  # MJX: `warp`: a kernel of Warp (extra) in its place

    def caps(self, slots: int) -> tuple[int, int]:
        """Return how many geom pairs and contacts MJX keeps with `slots` objects; -1 means all."""
        given = (self.geom_pairs, self.contact_points)
        return tuple(-1 if cap is None else max(cap[0], cap[1] * slots) for cap in given)  # type: ignore[return-value]


class Engine(Protocol):
    """Simulates batches of independent scenes.

    Threads may share one: `native` steps their batches side by side, the others one by one.
    """

    name: str
    config: PhysicsConfig
    batch: int
    """Number of scenes that it simulates fastest: data sets are made in batches of that size."""

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
        """Follow `trajectories` from rest.

        Args:
          scenes: B scenes.
          poses: initial poses (metres, quaternions wxyz, workspace); velocities are zero.
          trajectories: one a scene; the gripper starts at the first key frame.
          samples: seconds, increasing, common to the batch; the simulation ends at the last.
          settle: flag episodes in which something still moves at the end.
          fence: seconds from the start for which objects are kept near the workspace's centre (`fence_force`).

        Returns:
          Rollout with a leading `[B]`; what went wrong is in `fault`.

        Raises:
          Stopped: `stop` was called.
        """
        ...

    def stop(self) -> None:
        """End `simulate`, now and in all later calls, as soon as possible; to be called from another thread."""
        ...


@runtime_checkable
class DeviceEngine(Engine, Protocol):
    """An engine that can return before its results are there."""

    def on_device(self) -> Engine | None:
        """Return this engine for arrays that stay on its device: `simulate` does not wait, and can be traced.

        None if it has several devices, between which rows would travel, or a CPU, where nothing is gained.
        """
        ...


class Stopped(Exception):
    """Raised by `Engine.simulate` after `Engine.stop` was called."""
