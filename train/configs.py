"""How networks are trained, options of `dipn-train`. Importing this imports no JAX."""

from __future__ import annotations

import dataclasses
import pathlib
import re
from typing import Literal

import tyro

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files

Preset = Literal["compact", "paper"]
"""Architecture of a network: ours, or as published."""
ShapeClass = Literal["cuboid", "cylinder", "half_cylinder", "triangular_prism", "concave"]
"""A class of shapes, as in `shapes.CLASSES`."""
LearnerName = Literal["vpg", "rea", "dqn"]
"""A compared method that learns while it acts."""
LARGEST_BATCH = 65_536
"""Most examples in a step, and most tables that are acted on side by side."""
LAST_PORT = 65_535
"""The highest number of a port."""
_ADDRESS = re.compile(r"(?:\[[0-9A-Fa-f:.%]+\]|[\w.-]+):(?P<port>[0-9]{1,5})", re.ASCII)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How a network learns from a data set.

    Attributes:
      steps: Optimizer steps.
      batch: Examples in a step.
      learning_rate: highest learning rate of the run; adamw decays from it by a cosine.
      weight_decay: factor of the weights in the decay of each step, 0 to 1.
      optimizer: adamw with cosine decay; sgd with momentum 0.9 and a constant rate; or published, as DIPN was: sgd
        whose rate rises in the first epoch and falls to a tenth after each third of the steps.
      seed: Seed of weights, order and augmentation.
      mix: For each folder of --data, how much of every batch is taken from it (3 1: three quarters from the first); an
        epoch then ends for each by itself. Without it, every example is seen once an epoch.
      eval_every: Steps between points of the learning curve.
      save_every: Steps between checkpoints.
    """

    steps: int = 2000
    batch: int = 32
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    optimizer: Literal["adamw", "sgd", "published"] = "adamw"
    seed: int = 0
    mix: tuple[float, ...] = ()
    eval_every: int = 200
    save_every: int = 200

    def __post_init__(self) -> None:
        console.require_positive(
            steps=self.steps,
            learning_rate=self.learning_rate,
            eval_every=self.eval_every,
            save_every=self.save_every,
        )
        console.require_between(1, LARGEST_BATCH, batch=self.batch)
        console.require_between(0, 1, weight_decay=self.weight_decay)
        console.require_seed(self.seed)
        for weight in self.mix:
            console.require_positive(mix=weight)


@dataclasses.dataclass(frozen=True)
class Compute:
    """How steps are computed.

    Attributes:
      data_parallel: Share each batch among all devices: of this machine, or of all processes of the job. What is learnt
        is the same but for rounding, and a run may continue with another number of devices.
      accumulate: Parts that each batch is computed in, one after another, for less memory. The gradient is the mean of
        theirs, and each has its own statistics and random numbers.
      precision: Precision of what the network's layers compute; weights, statistics and losses stay float32.
      memory: GB of episodes, and of examples of push and grasp with compact networks, kept in memory. If episodes need
        more, they are kept in files that are gone when the command ends; if examples do, each is made when it is first
        used and kept in files under OUT/examples, which may be deleted afterwards.
      compile_only: Compile a step, say what memory it needs, and write nothing but the compiled program that JAX keeps.
      check_only: Check options, data and OUT, and write nothing.
      profile: Folder for a profile of ten steps, for TensorBoard or Perfetto.
      coordinator: HOST:PORT of process 0 of a job of several; SLURM, Open MPI and Kubernetes tell it themselves.
      processes: Number of processes of the job, with --coordinator.
      process: Which of them this one is, counted from 0, with --coordinator.
    """

    data_parallel: bool = False
    accumulate: int = 1
    precision: Literal["float32", "bfloat16"] = "float32"
    memory: float = 8.0
    compile_only: bool = False
    check_only: bool = False
    profile: pathlib.Path | None = None
    coordinator: str = ""
    processes: int = 1
    process: int = 0

    def __post_init__(self) -> None:
        console.require_positive(accumulate=self.accumulate)
        console.require_between(0, 1e6, memory=self.memory)
        given = f"--processes {self.processes} --process {self.process}"
        if not self.coordinator:
            if (self.processes, self.process) != (1, 0):
                raise UserError(f"{given}: needs --coordinator HOST:PORT, the address of process 0")
            return
        parts = _ADDRESS.fullmatch(self.coordinator)
        if not (parts and 1 <= int(parts["port"]) <= LAST_PORT):
            raise UserError(
                f"--coordinator {self.coordinator}: want HOST:PORT, the address of process 0 and a free port of it, 1 "
                f"to {LAST_PORT}"
            )
        if not 0 <= self.process < self.processes:
            raise UserError(f"{given}: want the number of processes, and which of them this one is, counted from 0")
        if not self.data_parallel:
            raise UserError(f"--coordinator {self.coordinator}: needs --data-parallel, by which processes share a run")


DEFAULT_COMPUTE = Compute()
"""One device, whole batches, single precision."""


def check(config: TrainConfig, compute: Compute, out: pathlib.Path, *, data_sets: int) -> None:
    """Raise a UserError where options do not fit one another, or `out` cannot be written to.

    Each option by itself is checked when it is given.

    Args:
      config: how to learn.
      compute: how steps are computed.
      out: run folder.
      data_sets: number of data sets to learn from.
    """
    if config.batch % compute.accumulate:
        raise UserError(
            f"--batch {config.batch} --accumulate {compute.accumulate}: want a number that divides the batch"
        )
    check_mix(config, data_sets=data_sets)
    check_out(out)


def check_out(out: pathlib.Path) -> None:
    """Raise a UserError where no run can be kept in `out`."""
    console.require_out(out)
    files.require_locale(out)
    if out.name.isdecimal() and out.parent.name == "checkpoints":
        raise UserError(f"--out {out}: the folder of a step; give its run, {out.parents[1]}, or another folder")


def check_mix(config: TrainConfig, *, data_sets: int) -> None:
    """Raise a UserError where the mix is not one of this number of data sets."""
    if config.mix and len(config.mix) != data_sets:
        given = " ".join(f"{weight:g}" for weight in config.mix)
        raise UserError(f"--mix {given}: want a number for each folder of --data, {data_sets}")


@dataclasses.dataclass(frozen=True)
class OnlineConfig:
    """How GN learns while it grasps."""

    grasps: int = 300
    """Number of grasps."""
    tables: int = 10
    """Tables that are grasped from side by side."""
    updates: int = 20
    """Optimizer steps after each round of one grasp on every table."""
    batch: int = 32
    """Outcomes in a step."""
    learning_rate: float = 5e-4
    """Learning rate, constant."""
    weight_decay: float = 1e-4
    """Factor of the weights in the decay of each step, 0 to 1."""
    seed: int = 0
    """Seed of scenes, weights, order and augmentation."""
    pretrained: tyro.conf.Suppress[bool] = False
    """Whether the network has learnt from images; for the record."""


@dataclasses.dataclass(frozen=True)
class BaselineConfig:
    """How a compared method learns while it acts."""

    method: LearnerName = "vpg"
    """vpg, rea or dqn."""
    preset: Preset = "compact"
    """Architecture; paper has two DenseNet-121 trunks for each primitive, for an accelerator."""
    actions: int = 2500
    """Pushes and grasps in all."""
    tables: int = 10
    """Tables that are acted on side by side."""
    updates: int = 20
    """Optimizer steps after each round of one action on every table."""
    batch: int = 32
    """Outcomes in a step, of pushes and of grasps each."""
    learning_rate: float = 5e-4
    """Learning rate, constant."""
    weight_decay: float = 1e-4
    """Factor of the weights in the decay of each step, 0 to 1."""
    seed: int = 0
    """Seed of scenes, weights, order and exploration."""
