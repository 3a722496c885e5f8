"""Exports with a row, or an entry of every array, for each episode: Parquet and NumPy files, a file for each part."""

from __future__ import annotations

import contextlib
import os
import pathlib
import zipfile
from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dipn_jax.system import files, temporary

from .columns import Column, Values
from .source import Part

LEVEL = 3
"""Level of zstd: float32 numbers become little smaller by a higher one."""
SAME_TIME = 86400 * 365 * 20
"""Time of every array in a file of NumPy's (1989), so that the same export gives the same bytes."""


class Parquet:
    """Plain Parquet: a column is a number, or a list of fixed length with the array in row-major order."""

    def __init__(self, out: pathlib.Path, columns: Sequence[Column], slots: int) -> None:
        self.out, self.columns, self.slots = out, columns, slots

    def path(self, part: Part) -> pathlib.Path:
        """Return the file of a part."""
        return self.out / "data" / f"{part.name}.parquet"

    def done(self, part: Part) -> bool:
        """Return whether a part has been written."""
        return self.path(part).exists()

    def write(self, part: Part, blocks: Iterator[Values]) -> None:
        """Write a part, whole or not at all."""
        schema = pa.schema([self._field(column) for column in self.columns])
        with (
            files.replacing(self.path(part)) as path,
            pq.ParquetWriter(path, schema, compression="zstd", compression_level=LEVEL) as writer,
        ):
            for values in blocks:
                arrays = [self._array(values[column.name], field) for column, field in self._pairs(schema)]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))

    def finish(self, parts: Sequence[Part]) -> None:
        """Do nothing: every part is a file of its own."""

    def _pairs(self, schema: pa.Schema) -> list[tuple[Column, pa.Field]]:
        return list(zip(self.columns, schema, strict=True))

    def _field(self, column: Column) -> pa.Field:
        plain = pa.from_numpy_dtype(np.dtype(column.dtype))
        lengths = column.lengths(self.slots)
        about = {"shape": " ".join(map(str, lengths)), "meaning": column.meaning}
        kind = pa.list_(plain, int(np.prod(lengths))) if lengths else plain
        return pa.field(column.flat_name, kind, nullable=False, metadata=about)

    @staticmethod
    def _array(values: np.ndarray, field: pa.Field) -> pa.Array:
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        return flat if flat.type == field.type else pa.FixedSizeListArray.from_arrays(flat, type=field.type)


class Npz:
    """NumPy's own files: each array has the shape of its column behind the axis of the episodes."""

    def __init__(self, out: pathlib.Path, columns: Sequence[Column], slots: int) -> None:
        self.out, self.columns, self.slots = out, columns, slots

    def path(self, part: Part) -> pathlib.Path:
        """Return the file of a part."""
        return self.out / "data" / f"{part.name}.npz"

    def done(self, part: Part) -> bool:
        """Return whether a part has been written."""
        return self.path(part).exists()

    def write(self, part: Part, blocks: Iterator[Values]) -> None:
        """Write a part, whole or not at all; its arrays are on the disk, not in memory, until they are packed."""
        self.path(part).parent.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            folder = temporary.temporary_path(self.out / "npz")
            folder.mkdir()
            stack.callback(files.remove_folder, folder)
            arrays = {column.name: self._array(folder, column, part.count) for column in self.columns}
            begin = 0
            for values in blocks:
                count = len(values["episode"])
                for name, array in arrays.items():
                    array[begin : begin + count] = values[name]
                begin += count
            for array in arrays.values():
                array.flush()
            path = stack.enter_context(files.replacing(self.path(part)))
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
                for name in arrays:
                    os.utime(folder / f"{name}.npy", (SAME_TIME, SAME_TIME))
                    packed.write(folder / f"{name}.npy", f"{name}.npy")

    def finish(self, parts: Sequence[Part]) -> None:
        """Do nothing: every part is a file of its own."""

    def _array(self, folder: pathlib.Path, column: Column, count: int) -> np.memmap:
        shape = (count, *column.lengths(self.slots))
        return np.lib.format.open_memmap(folder / f"{column.name}.npy", mode="w+", dtype=column.dtype, shape=shape)
