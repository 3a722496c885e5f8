"""Exports of steps: HDF5 in robomimic's layout, and Zarr in that of replay buffers."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from dipn_jax.system import files

from . import steps
from .columns import Column, Values
from .source import SPLITS, Part

CHUNK_BYTES = 1 << 20
"""Bytes of a chunk of a Zarr array, about, before it is compressed."""
MASKS = {"train": "train", "test": "valid"}
"""What robomimic calls the splits."""


class Hdf5:
    """One file in robomimic's layout: `data/demo_0/obs/poses`, `data/demo_0/actions`, ..., `mask/train`."""

    def __init__(self, out: pathlib.Path, kind: str, images: str) -> None:
        self.out, self.kind, self.path = out, kind, out / "data.hdf5"
        self.step, self.episode = steps.step_columns(kind, images), steps.episode_columns(kind)

    def _part(self, part: Part) -> pathlib.Path:
        return self.out / "parts" / f"{part.name}.hdf5"

    def done(self, part: Part) -> bool:
        """Return whether a part has been written."""
        return self.path.exists() or self._part(part).exists()

    def write(self, part: Part, blocks: Iterator[Values]) -> None:
        """Write a part, whole or not at all, to a file of its own."""
        import h5py

        with files.replacing(self._part(part)) as path, h5py.File(path, "w") as file:
            for values in blocks:
                stepped = steps.steps(self.kind, values)
                for row, number in enumerate(values["episode"]):
                    demo = file.create_group(f"demo_{number}")
                    demo.attrs["num_samples"] = steps.length(self.kind)
                    self._demo(demo, {k: v[row] for k, v in stepped.items()}, {k: v[row] for k, v in values.items()})

    def _demo(self, demo: Any, stepped: Values, values: Values) -> None:
        for column in self.step:
            name = "actions" if column.name == "action" else f"obs/{column.name}"
            packed = {"compression": "gzip", "compression_opts": 1} if stepped[column.name].nbytes > 1 << 16 else {}
            demo.create_dataset(name, data=stepped[column.name], **packed)
        count = steps.length(self.kind)
        demo.create_dataset("dones", data=np.arange(count) == count - 1)
        demo.create_dataset("rewards", data=np.full(count, float(values.get("success", 0)), np.float32))
        for column in self.episode:
            demo.create_dataset(f"episode/{column.name}", data=values[column.name])

    def finish(self, parts: Sequence[Part]) -> None:
        """Join the parts to one file."""
        import h5py

        if not self.path.exists():
            with files.replacing(self.path) as path, h5py.File(path, "w") as file:
                data = file.create_group("data")
                data.attrs["total"] = steps.length(self.kind) * sum(part.count for part in parts)
                about = {"env_name": f"dipn-jax {self.kind}", "type": 4, "env_kwargs": {}}
                data.attrs["env_args"] = json.dumps(about)
                for part in parts:
                    with h5py.File(self._part(part), "r") as one:
                        for name in one:
                            one.copy(name, data)
                for split in SPLITS:
                    self._mask(file, split, [part for part in parts if part.split == split])
        shutil.rmtree(self.out / "parts", ignore_errors=True)

    @staticmethod
    def _mask(file: Any, split: str, parts: list[Part]) -> None:
        """List the names of the episodes of a split, as robomimic's `mask` does."""
        longest = len(f"demo_{parts[-1].shard.first + parts[-1].shard.count}")
        names = file.create_dataset(f"mask/{MASKS[split]}", (sum(part.count for part in parts),), f"S{longest}")
        for part in parts:
            numbers = range(part.shard.first + part.rows.start, part.shard.first + part.rows.stop)
            names[part.first : part.first + part.count] = [f"demo_{number}".encode() for number in numbers]


class Zarr:
    """A folder for each split: flat arrays of all steps in `data`, and where each episode ends in `meta/episode_ends`.

    What each episode has beside its steps is in `meta`, too.
    """

    def __init__(self, out: pathlib.Path, kind: str, slots: int, images: str) -> None:
        self.out, self.kind, self.slots = out, kind, slots
        self.step, self.episode = steps.step_columns(kind, images), steps.episode_columns(kind)
        self._noted = out / "done.json"

    def _names(self) -> list[str]:
        return files.read_json(self._noted, wanted=[str]) if self._noted.exists() else []

    def done(self, part: Part) -> bool:
        """Return whether a part has been written."""
        return part.name in self._names()

    def write(self, part: Part, blocks: Iterator[Values]) -> None:
        """Write a part at its place in the arrays; it counts as written when it is noted.

        A chunk in which two parts meet is replaced whole, so the earlier part stays as it is.
        """
        count, begin = steps.length(self.kind), part.first
        root = self._open(part.split)
        for values in blocks:
            end = begin + len(values["episode"])
            stepped = steps.steps(self.kind, values)
            for column in self.step:
                flat = stepped[column.name].reshape(-1, *stepped[column.name].shape[2:])
                self._append(root, f"data/{column.name}", column, flat, begin * count)
            for column in self.episode:
                self._append(root, f"meta/{column.name}", column, values[column.name], begin)
            ends = count * np.arange(begin + 1, end + 1, dtype=np.int64)
            self._append(root, "meta/episode_ends", Column("episode_ends", (), "int64", ""), ends, begin)
            begin = end
        os.sync()
        files.write_json(self._noted, [*self._names(), part.name])

    def _open(self, split: str) -> Any:
        import zarr

        return zarr.open_group(self.out / f"{split}.zarr", mode="a", zarr_format=2)

    def _append(self, root: Any, name: str, column: Column, values: np.ndarray, begin: int) -> None:
        """Write rows of an array from row `begin` on, and make the array end with them."""
        import numcodecs

        if name not in root:
            lengths = column.lengths(self.slots)
            size = int(np.prod(lengths)) * np.dtype(column.dtype).itemsize
            root.create_array(
                name,
                shape=(0, *lengths),
                chunks=(max(1, CHUNK_BYTES // max(1, size)), *lengths),
                dtype=column.dtype,
                compressors=numcodecs.Blosc(cname="zstd", clevel=3, shuffle=numcodecs.Blosc.BITSHUFFLE),
                attributes={"meaning": column.meaning},
            )
        array = root[name]
        array.resize((begin + len(values), *values.shape[1:]))
        array[begin:] = values

    def finish(self, parts: Sequence[Part]) -> None:
        """Delete what processes that were killed have left of files that were being replaced."""
        for path in self.out.glob("*.zarr/**/*.partial"):
            path.unlink(missing_ok=True)
