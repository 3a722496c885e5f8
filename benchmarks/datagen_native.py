"""Data generation on MuJoCo C against the bare steps inside it, which are the same bit for bit."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np
from dipn_jax.datagen.generate import Job
from mujoco import batch as mujoco_batch

from benchmarks.harness import Setting, alternate, make_data
from dipn_jax.world import scenes

ACTIONS = {"push": 3, "grasp": 6}
"""Actions tried on one scene, the defaults of the commands."""
SHARDS = 4
"""Number of shards of the data set."""
INPUTS = ("ctrl", "qfrc_applied")
"""What the engine sets between steps."""


@dataclasses.dataclass
class Tape:
    """One recorded batch of simulations: how it began, what was set before each call of `step`, how it ended."""

    nthread: int
    models: list[Any] = dataclasses.field(default_factory=list)
    start: np.ndarray | None = None  # [B, nq]
    calls: list[tuple[dict[str, np.ndarray], dict[str, Any]]] = dataclasses.field(default_factory=list)
    end: np.ndarray | None = None  # [B, nq]


@contextlib.contextmanager
def recording() -> Iterator[list[Tape]]:
    """Make the native engine record a tape of every batch that it simulates in this context."""
    tapes: list[Tape] = []

    class Recorder(mujoco_batch.Batch):
        def __init__(self, model: Any, **options: Any) -> None:
            super().__init__(model, **options)
            self.tape = Tape(options["nthread"])
            tapes.append(self.tape)

        def set_models(self, models: Any) -> None:
            super().set_models(models)
            self.tape.models = models

        def step(self, **options: Any) -> None:
            tape = self.tape
            if tape.start is None:
                tape.start = np.array(self.qpos)
            tape.calls.append(({name: np.array(getattr(self, name)) for name in INPUTS}, options))
            try:
                super().step(**options)
            finally:
                tape.end = np.array(self.qpos)

    with mock.patch.object(mujoco_batch, "Batch", Recorder):
        yield tapes


class Replay:
    """A tape ready to be stepped again, with nothing else between the steps."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.sims = mujoco_batch.Batch(tape.models[0], nsim=len(tape.models), nthread=tape.nthread, persistent=True)
        self.sims.set_models(tape.models)
        self.sims.qpos[:] = tape.start
        self.inputs = {name: getattr(self.sims, name) for name in INPUTS}

    def run(self) -> None:
        """Step without anything else."""
        for values, options in self.tape.calls:
            for name, value in values.items():
                self.inputs[name][:] = value
            with contextlib.suppress(mujoco_batch.SimulationError):  # a diverged one stops, as it did when recorded
                self.sims.step(**options)

    def check(self) -> None:
        """Check that the replay passed through the same states.

        Raises:
          RuntimeError: they were not, so the two times do not belong together.
        """
        if not np.array_equal(np.asarray(self.sims.qpos), self.tape.end, equal_nan=True):  # type: ignore[arg-type]
            raise RuntimeError("the bare steps end elsewhere: the engine sets more than datagen_native.INPUTS")


def share(setting: Setting, kind: str, objects: int) -> float:
    """Measure seconds of the bare steps over seconds of the data set that they were recorded in."""
    size = setting.pick(96, 480)
    job = Job(
        kind=kind,
        scene=scenes.fixed_count(objects),
        episodes=SHARDS * size,
        seed=setting.seed,
        shard_size=size,
        actions=ACTIONS[kind],
        engine="native",
    )
    with recording() as tapes:  # also compiles what JAX has to
        make_data(job)
    tapes = [tape for tape in tapes if tape.start is not None]
    ready: list[list[Replay]] = []

    def prepare() -> None:
        ready.append([Replay(tape) for tape in tapes])

    def bare() -> None:
        for replay in ready[-1]:
            replay.run()

    times = []
    for _ in range(setting.pick(3, 2)):
        prepare()
        times.append(alternate(bare, lambda: make_data(job), repeats=1))
        for replay in ready.pop():
            replay.check()
    return sum(first for first, _ in times) / sum(second for _, second in times)


def share_of_bare(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure pushes on disk per second over what the engine's steps alone would allow."""
    for objects in (7, 10):
        yield f"datagen_native.share_of_bare/{objects}", share(setting, "push", objects)


def grasp_share_of_bare(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure grasps on disk per second over what the engine's steps alone would allow."""
    yield "datagen_native.grasp_share_of_bare/10", share(setting, "grasp", 10)
