"""How networks are trained, options of `dipn-train`. Importing this imports no JAX."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Literal

import tyro

Preset = Literal["compact", "paper"]
"""Architecture of a network: ours, or as published."""
ShapeClass = Literal["cuboid", "cylinder", "half_cylinder", "triangular_prism", "concave"]
"""A class of shapes, as in `shapes.CLASSES`."""
LearnerName = Literal["vpg", "rea", "dqn"]
"""A compared method that learns while it acts."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How a network learns from a data set."""

    steps: int = 2000
    """Optimizer steps."""
    batch: int = 32
    """Examples in a step."""
    learning_rate: float = 1e-3
    """The highest learning rate of the run."""
    weight_decay: float = 1e-4
    """Weight decay."""
    optimizer: Literal["adamw", "sgd", "published"] = "adamw"
    """adamw with cosine decay; sgd with momentum 0.9 and a constant rate; or published, as DIPN was: sgd whose rate
    rises in the first epoch and falls to a tenth after each third of the steps."""
    seed: int = 0
    """Seed of weights, order and augmentation."""
    mix: tuple[float, ...] = ()
    """For each folder of --data, how much of every batch is taken from it (3 1: three quarters from the first); an
    epoch then ends for each by itself. Without it, every example is seen once an epoch."""
    eval_every: int = 200
    """Steps between points of the learning curve."""
    save_every: int = 200
    """Steps between checkpoints."""


@dataclasses.dataclass(frozen=True)
class Compute:
    """How steps are computed."""

    data_parallel: bool = False
    """Share each batch among all devices: of this machine, or of all processes of the job. What is learnt is the same
    but for rounding, and a run may go on with another number of devices."""
    accumulate: int = 1
    """Parts that each batch is computed in, one after another, for less memory. The gradient is the mean of theirs, and
    each has its own statistics and random numbers."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of what the network's layers compute; weights, statistics and losses stay float32."""
    memory: float = 8.0
    """GB of examples kept in memory, by push and grasp with compact networks. If there are more, each is made when it
    is first used and kept in files under OUT/examples; these may be deleted afterwards."""
    compile_only: bool = False
    """Compile a step, say what memory it needs, and write nothing but the compiled program that JAX keeps."""
    check_only: bool = False
    """Check options, data and OUT, and write nothing."""
    profile: pathlib.Path | None = None
    """Folder for a profile of ten steps, for TensorBoard or Perfetto."""
    coordinator: str = ""
    """HOST:PORT of process 0 of a job of several; SLURM, Open MPI and Kubernetes tell it themselves."""
    processes: int = 1
    """Number of processes of the job, with --coordinator."""
    process: int = 0
    """Which of them this one is, counted from 0, with --coordinator."""


DEFAULT_COMPUTE = Compute()
"""One device, whole batches, single precision."""


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
    """Weight decay."""
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
    """Weight decay."""
    seed: int = 0
    """Seed of scenes, weights, order and exploration."""
