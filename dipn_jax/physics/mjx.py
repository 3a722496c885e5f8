"""MuJoCo MJX: whole batches in one XLA program, on a GPU, a TPU or a CPU.

Shapes, sizes, masses, friction, poses and trajectories are traced; only the number of scenes and of object
slots is compiled in. So all primitives and all scenes of one layout share one program (see `prisms` for how).

Friction cones are elliptic, as in the native engine, with our own solver (`cone`), because MJX's diverges in float32.
MJX cannot be given another solver, so making an engine patches MJX in the whole process (see `patches`). Where the
configuration says `warp`, time steps are not MJX's: they are those of one kernel (see `tick`), and nothing is patched.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dipn_jax import physics
from dipn_jax.engine import PhysicsConfig, Stopped
from dipn_jax.errors import UserError
from dipn_jax.physics import patches, program_cache, tick
from dipn_jax.physics.mjx_program import Program
from dipn_jax.structs import Array, Rollout, Scene, Trajectory

DEFAULTS = PhysicsConfig(
    timestep=0.0025,  # as near to the native engine's 0.002 as its own 0.001 is; at 0.005 1 grasp in 10 ends otherwise
    geom_pairs=(32, 4),  # measured: at most 26 overlapping bounding spheres (10 objects, a push)
    contact_points=(80, 8),  # measured: at most 54 contacts with 7 objects, 75 with 10
)
"""Settings of the solver unless others are given."""
PADDED_KEY_FRAMES = 8
"""Key frames that every trajectory is padded to, so that all primitives share one program."""
PADDED_SAMPLES = 12
"""Sampled instants that every request is padded to, so that all primitives share one program."""


class MjxEngine:
    """An `Engine` on MuJoCo MJX.

    Making one patches MJX in the whole process, for models of this package only, unless its solver is `warp`.

    The patches replace MJX's constraint solver and its colliders of meshes with planes, boxes and meshes (`patches`).
    Models that were not made from our MJCF are passed on to MJX's own functions, so other code that uses MJX in the
    same process gets the results that it would get without an engine.
    """

    name = "mjx"

    def __init__(
        self, config: PhysicsConfig = DEFAULTS, *, chunk: int | None = None, devices: Sequence[jax.Device] | None = None
    ) -> None:
        """Make an engine, and patch MJX unless `warp` solves; programs are compiled when a layout is first simulated.

        Args:
          config: solver settings; the control period must be a whole number of time steps.
          chunk: most scenes simulated at once, which bounds the memory; a power of two. If not given, 16 on a CPU (with
            solver `xla` more cost 1.4 times as much a scene, because all wait for the slowest), else 1024.
          devices: devices that share every chunk; all local ones if not given. A power of two of them are used.

        Raises:
          UserError: the control period is not a whole number of time steps, `chunk` is no power of two, or the Warp
            solver is asked for and cannot be used here.
        """
        self.substeps = physics.substeps(config)
        local = list(devices or jax.local_devices())
        if config.solver == "warp":
            tick.check(local[0].platform)
        else:
            patches.register()
        self.config = config
        self.devices = local[: 1 << (len(local).bit_length() - 1)]
        if chunk and chunk & (chunk - 1):
            raise UserError(f"mjx: chunk {chunk}; want a power of two")
        on_cpu = self.devices[0].platform == "cpu"
        self.chunk, self.batch = chunk or (16 if on_cpu else 1024), 64 if on_cpu else 1024
        # by number of scenes, slots, instants and key frames
        self.programs: dict[tuple[int, ...], Callable[..., Rollout]] = {}
        self._stopped, self._lock = threading.Event(), threading.Lock()

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
        """See `Engine.simulate`; returns NumPy arrays."""
        scenes, poses, trajectories = jax.tree.map(np.asarray, (scenes, poses, trajectories))
        return self._simulate(scenes, poses, trajectories, samples, settle=settle, fence=fence, xp=np)

    def on_device(self) -> OnDevice | None:
        """See `DeviceEngine.on_device`; it shares programs, and `stop`, with this one."""
        alone = len(self.devices) == 1 and self.devices[0].platform != "cpu"
        return OnDevice(self) if alone else None

    def _simulate(
        self,
        scenes: Scene,
        poses: Array,
        trajectories: Trajectory,
        samples: Array,
        *,
        settle: bool,
        fence: float,
        xp: ModuleType,
    ) -> Rollout:
        """Simulate in chunks; with `xp` numpy the results are fetched, with jax.numpy nothing waits for them."""
        ticks = np.round(np.asarray(samples) / physics.CONTROL_PERIOD).astype(np.int32)
        padded = np.append(ticks, np.full(max(PADDED_SAMPLES - len(ticks), 0), -1, np.int32))
        args = scenes, poses, _pad(trajectories, xp)
        batch, slots = scenes.shape.shape
        # powers of two, so that batches of many sizes share few programs
        size = max(min(1 << (batch - 1).bit_length(), self.chunk), len(self.devices))
        done: list[Rollout] = []
        # MJX relies on rank promotion; contacts need whole float32 products, which accelerators else shorten
        with self._lock, jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
            for start in range(0, batch, size):
                rows = np.minimum(np.arange(start, start + size), batch - 1)
                part = jax.tree.map(lambda leaf, rows=rows: leaf[rows], args)
                if self._stopped.is_set():
                    raise Stopped
                whole = *part, _room(size, len(padded), slots), padded, np.bool_(settle), np.float32(fence)
                fresh = self._program(size, slots, whole)(*whole)
                last = done[-1:] if xp is jnp else jax.device_get(done[-1:])  # fetched while the next one runs
                done = [*done[:-1], *last, fresh]
        out = jax.tree.map(lambda *leaves: xp.concatenate([xp.asarray(x) for x in leaves])[:batch], *done)
        return Rollout(out.poses[:, : len(ticks)], out.gripper[:, : len(ticks)], out.fault)

    def _program(self, size: int, slots: int, arguments: tuple[Any, ...]) -> Callable[..., Rollout]:
        """Return the compiled function for `size` scenes of `slots` objects; each device runs its share by itself."""
        key = size, slots, len(arguments[4]), arguments[2].time.shape[1]
        if key not in self.programs:
            made = Program(self.config, slots, self.substeps)
            alone = len(self.devices) == 1 and self.devices[0].platform == jax.default_backend()
            kept_on_disk = alone and self.config.solver == "xla"  # a call of Warp is of this process
            self.programs[key] = self._kept(made, arguments) if kept_on_disk else self._shared(made)
        return self.programs[key]

    def _shared(self, made: Program) -> Callable[..., Rollout]:
        """Return the function compiled for all devices."""
        mesh = jax.sharding.Mesh(np.array(self.devices), ("batch",))
        split, whole = jax.sharding.PartitionSpec("batch"), jax.sharding.PartitionSpec()
        run = jax.shard_map(
            made.run,
            mesh=mesh,
            in_specs=(split, split, split, split, whole, whole, whole),
            out_specs=split,
            check_vma=False,  # MJX starts its loops from constants, which that check refuses
        )
        return jax.jit(run, donate_argnums=3)

    def _kept(self, made: Program, arguments: tuple[Any, ...]) -> Callable[..., Rollout]:
        """Return the function compiled for the only device; its trace is kept on disk for other processes."""
        tree = jax.tree.structure(arguments)
        first = len(jax.tree.leaves(arguments[:3]))  # of the record's memory

        def flat(*leaves: jax.Array) -> tuple[Array, ...]:
            out = made.run(*jax.tree.unflatten(tree, leaves))
            return out.poses, out.gripper, out.fault

        donate = range(first, first + len(arguments[3]))
        call = program_cache.program(flat, jax.tree.leaves(arguments), what=f"mjx {self.config} highest", donate=donate)

        def run(*args: Any) -> Rollout:
            with jax.default_device(self.devices[0]):
                return Rollout(*call(*jax.tree.leaves(args)))

        return run

    def stop(self) -> None:
        """See `Engine.stop`: it ends after the present chunk."""
        self._stopped.set()


class OnDevice:
    """An `Engine` that returns before the result is there, as arrays on the device; it can be traced.

    So what is computed from one rollout, and simulated next, waits for no copy to the host.
    """

    def __init__(self, engine: MjxEngine) -> None:
        """Make it for `engine`, whose programs it shares."""
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
        """See `Engine.simulate`; returns arrays on the device."""
        scenes, poses, trajectories = jax.tree.map(jnp.asarray, (scenes, poses, trajectories))
        return self._engine._simulate(scenes, poses, trajectories, samples, settle=settle, fence=fence, xp=jnp)

    def stop(self) -> None:
        """See `Engine.stop`."""
        self._engine.stop()


def _room(batch: int, samples: int, slots: int) -> tuple[Array, Array]:
    """Return memory for the poses and the gripper of a record, which the result takes over."""
    return np.zeros((batch, samples, slots, 7), np.float32), np.zeros((batch, samples, 5), np.float32)


def _pad(trajectories: Trajectory, xp: ModuleType) -> Trajectory:
    """Return trajectories of `PADDED_KEY_FRAMES` key frames at least: the last one repeats, a second apart."""
    time, target = xp.asarray(trajectories.time, np.float32), xp.asarray(trajectories.target, np.float32)
    more = max(PADDED_KEY_FRAMES - time.shape[1], 0)
    later = time[:, -1:] + np.arange(1, more + 1, dtype=np.float32)
    return Trajectory(xp.concatenate([time, later], 1), xp.concatenate([target, *[target[:, -1:]] * more], 1))
