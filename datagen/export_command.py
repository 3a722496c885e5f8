"""The command `dipn-datagen export`. Importing this imports no JAX."""

from __future__ import annotations

import pathlib
from typing import Annotated, Literal

import tyro

from dipn_jax.system import addresses
from dipn_jax.system.addresses import Place

Format = Literal["parquet", "npz", "hdf5", "zarr", "lerobot"]
"""Format of an export."""
Images = Literal["none", "before", "after", "both", "all"]
"""What is rendered of each episode."""


def export(
    data: tyro.conf.Positional[Place],
    out: pathlib.Path,
    format_: Annotated[Format, tyro.conf.arg(name="format")] = "parquet",
    images: Images = "none",
) -> None:
    """Write a data set as plain numbers that other programs read: float32, metres, radians, the frame of the workspace.

    A table for pandas, polars, DuckDB or Hugging Face, a row for each episode, with what the camera sees before:
      dipn-datagen export data/push --out exported/push --images before

    Steps with observations and actions, for robomimic, replay buffers or LeRobot:
      dipn-datagen export data/push --out exported/push-hdf5 --format hdf5

    The files are described in README.md beside them. It is written shard by shard; the same command continues where it
    stopped.

    Args:
      data: a data set of pushes, grasps or images, or its URL.
      out: folder of the export.
      format_: parquet and npz: all numbers of an episode; hdf5 (as robomimic), zarr (as replay buffers) and lerobot
        (pushes): steps.
      images: height, colour and labels, rendered before or after the action, both, or at all eleven recorded moments
        of a push; a format of steps has all (pushes) or before.
    """
    from dipn_jax.storage import mirror

    from .exporting.export import export as write

    given = addresses.url(data) or str(data)
    command = ["dipn-datagen", "export", given, "--out", str(out), "--format", format_, "--images", images]
    write(mirror.local(data), out, form=format_, images=images, command=command)
