"""Shards of a data set: Parquet files of episodes. Only this module reads and writes them.

Every column is a leaf of an episode struct, flattened, and quantized as `codec` says; its shape, dtype and quantum,
the schema version, the kind, the config, the versions of the packages and the kind of processor that made it are in
the shard's own metadata. A shard is written under a temporary name, synced and renamed, so a file with a shard's name
is whole or was damaged later, which its SHA-256 in the manifest (`records`) shows. Whatever is in a file, reading it
ends with episodes or with a `UserError`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dipn_jax.errors import UserError
from dipn_jax.storage import codec, layout
from dipn_jax.storage.layout import KINDS
from dipn_jax.system import files, machine, typed

SCHEMA_VERSION = 3
"""Version of the format that is written."""
READABLE = (2, SCHEMA_VERSION)
"""Versions that are read; in 2, poses of pushes are differences in time. Shards of others are refused."""
COMPRESSION_LEVEL = 9
"""Level of zstd; it takes a few milliseconds a shard, because bytes of the same place of all numbers are neighbours."""
ROUNDED_START = "rounded"
"""Entry `start` of the metadata: episodes were simulated from what is stored, so they can be simulated again exactly.

Shards without it are older: their episodes began within half a quantum of what is stored, and contact amplifies that.
"""
_META_KEY = b"dipn_jax"
"""Key of our entry in the metadata of a shard."""


class DamagedShard(UserError):
    """A file that was a shard, or has a shard's name, and cannot be read as one."""

    def __init__(self, path: pathlib.Path, what: str) -> None:
        super().__init__(f"shard {path}: {what}; run dipn-datagen repair {path.parent}")
        self.what = what


MOST_SHARDS = 100_000
"""Shards of a data set: with more, the order of their names would not be that of their numbers."""


def shard_path(folder: pathlib.Path, index: int) -> pathlib.Path:
    """Return the path of shard `index` of a data set."""
    return folder / f"shard-{index:05d}.parquet"


def shard_files(folder: pathlib.Path) -> list[pathlib.Path]:
    """Return the paths of the files with a shard's name in a folder, sorted."""
    return sorted(folder.glob("shard-*.parquet"))


def write_shard(
    folder: pathlib.Path, index: int, episodes: Any, *, kind: str, config: Any, faults: dict[str, Any]
) -> dict[str, Any]:
    """Write one shard, and return its entry in the manifest.

    Args:
      folder: the data set.
      index: the shard's number.
      episodes: a struct of `KINDS[kind]` with a leading `[B]` axis.
      kind: a key of `KINDS`.
      config: what determines the data set, with its seed; it has to fit into JSON.
      faults: counts of drops and faults.
    """
    columns, coded = codec.encode(codec.columns(episodes))
    arrays, specs = [], {}
    for name, value in columns.items():
        flat = np.ascontiguousarray(value).reshape(len(value), -1)
        arrays.append(pa.FixedSizeListArray.from_arrays(pa.array(flat.reshape(-1)), flat.shape[1]))
        specs[name] = {"dtype": str(value.dtype), "shape": list(value.shape[1:])} | coded.get(name, {})
    meta = {
        "schema_version": SCHEMA_VERSION,
        "kind": kind,
        "shard": index,
        "columns": specs,
        "config": config,
        "faults": faults,
        "start": ROUNDED_START,
        "versions": files.package_versions(),
        "processor": machine.processor(),
        "instructions": machine.instructions(),
    }
    table = pa.Table.from_arrays(arrays, names=list(columns))
    table = table.replace_schema_metadata({_META_KEY: json.dumps(meta).encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(
        table,
        sink,
        compression="zstd",
        compression_level=COMPRESSION_LEVEL,
        use_dictionary=False,
        column_encoding={f"{name}.list.element": "BYTE_STREAM_SPLIT" for name in coded},
        write_page_checksum=True,
    )
    data = sink.getvalue().to_pybytes()
    files.write_atomically(shard_path(folder, index), data)
    return _entry(len(arrays[0]), len(data), hashlib.sha256(data).hexdigest(), kind, faults)


def entry(path: pathlib.Path) -> dict[str, Any]:
    """Return the entry of a shard in the manifest of its data set.

    Raises:
      UserError: see `read_meta`.
    """
    meta = read_meta(path)
    return _entry(meta["episodes"], path.stat().st_size, files.file_sha256(path), meta["kind"], meta["faults"])


def _entry(episodes: int, size: int, sha256: str, kind: str, faults: dict[str, Any]) -> dict[str, Any]:
    return {"episodes": episodes, "bytes": size, "sha256": sha256, "kind": kind, "faults": faults}


@contextlib.contextmanager
def _reading(path: pathlib.Path) -> Iterator[None]:
    """Turn any error while reading a shard into a DamagedShard of one line.

    What is not the shard's fault, such as a disk that cannot be read, becomes a UserError.
    """
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"shard {path}: not found; generate it again with dipn-datagen") from None
    except OSError as error:
        if error.errno is not None:
            raise UserError(f"shard {path}: cannot be read ({error.strerror}); mend that and try again") from None
        raise DamagedShard(path, "truncated, damaged or not Parquet") from None
    except MemoryError:
        raise UserError(f"shard {path}: not enough memory to read it; make room and try again") from None
    except typed.Misfit as error:
        raise DamagedShard(path, f"its metadata are damaged: {error}") from None
    except Exception:
        raise DamagedShard(path, "truncated, damaged or not a shard of this project") from None


def _opened(path: pathlib.Path) -> pa.OSFile:
    """Return an open file, by the bytes of its name: Arrow takes a text for UTF-8, whatever the locale says."""
    return pa.OSFile(os.fsencode(path))


def read_meta(path: pathlib.Path) -> dict[str, Any]:
    """Return the metadata of a shard, which agree with its columns; and under `episodes`, how many it has.

    Raises:
      UserError: the file is missing, damaged (`DamagedShard`), not a shard, or of another schema version.
    """
    with _reading(path):
        files.require_regular(path)
        found = pq.read_metadata(_opened(path))
        schema = found.schema.to_arrow_schema()
        meta = typed.check(typed.parse((schema.metadata or {}).get(_META_KEY, b"{}")), {"schema_version": int})
        if meta["schema_version"] not in READABLE:
            raise UserError(
                f"shard {path}: schema version {meta['schema_version']}, want {' or '.join(map(str, READABLE))}; "
                "generate it anew elsewhere"
            )
        typed.check(meta, layout.META)
        if wrong := layout.problem(meta, schema):
            raise DamagedShard(path, wrong)
        if found.num_rows < 1:
            raise DamagedShard(path, "it holds no episodes")
        return {**meta, "episodes": found.num_rows}


def count(path: pathlib.Path) -> int:
    """Return the number of episodes in a shard."""
    return int(read_meta(path)["episodes"])


def require_kind(path: pathlib.Path, meta: dict[str, Any], kind: str) -> None:
    """Raise a UserError if a shard with these metadata holds episodes of another kind."""
    if meta["kind"] != kind:
        raise UserError(f"shard {path}: holds {meta['kind']} episodes, want {kind}; give another folder")


def slots(meta: dict[str, Any]) -> int:
    """Return the number of object slots in a shard with these metadata."""
    return int(meta["columns"]["scene.shape"]["shape"][0])


def empty(kind: str, meta: dict[str, Any]) -> Any:
    """Return what `read_shard` would of a shard of this kind with these metadata and no episodes: arrays `[0, ...]`."""
    columns = {
        name: np.empty((0, *spec["shape"]), np.float32 if "quantum" in spec else spec["dtype"])
        for name, spec in meta["columns"].items()
    }
    return codec.assemble(KINDS[kind], columns)


def read_shard(path: pathlib.Path, *, kind: str, sha256: str | None = None, into: Any = None) -> Any:
    """Return the episodes of a shard: a struct of `KINDS[kind]` with a leading `[B]` axis, NumPy arrays.

    Args:
      path: the file.
      kind: of its episodes.
      sha256: digest that the file had when it was checked, in hex; not compared if not given.
      into: a struct like the result, whose arrays the episodes are written to; new ones if not given.

    Raises:
      UserError: see `read_meta`; or the shard is of another kind, or is not the file that was checked.
    """
    with _reading(path):
        if sha256 is not None and files.file_sha256(path) != sha256:
            raise UserError(
                f"shard {path}: was changed since it was checked; leave a data set alone while it is used, and give "
                "the same command again"
            )
    meta = read_meta(path)
    require_kind(path, meta, kind)
    with _reading(path):
        return codec.assemble(KINDS[kind], _decoded(path, meta, meta["columns"], into=into))


def read_column(path: pathlib.Path, name: str, *, meta: dict[str, Any] | None = None) -> np.ndarray:
    """Return one leaf of the episodes of a shard, `[B, ...]`, and read nothing else.

    Args:
      path: the file.
      name: as `codec.columns` names it, such as `scene.size`; not `after`, which may be stored as a difference.
      meta: `columns` and `episodes` of its metadata, where these are known; they are read if not given.

    Raises:
      UserError: see `read_meta`.
    """
    meta = read_meta(path) if meta is None else meta
    with _reading(path):
        return _decoded(path, meta, [name])[name]


def _decoded(path: pathlib.Path, meta: dict[str, Any], names: Iterable[str], *, into: Any = None) -> codec.Columns:
    """Return columns `[B, ...]` of a shard; one that is stored as a difference has to be among them with the other."""
    specs = {name: meta["columns"][name] for name in names}
    with pq.ParquetFile(_opened(path), page_checksum_verification=True) as file:
        table = file.read(list(specs), use_threads=False)  # those who read many shards have threads of their own
    columns = {}
    for name, spec in specs.items():
        column = table.column(name).combine_chunks()
        flat = column.flatten()
        if column.null_count or flat.null_count:
            raise DamagedShard(path, f"its column {name} has empty places")
        values = _values(flat, np.dtype(spec["dtype"])).astype(spec["dtype"], copy="quantum" not in spec)
        columns[name] = values.reshape(meta["episodes"], *spec["shape"])
    coded = {name: spec for name, spec in specs.items() if "quantum" in spec}
    return codec.decode(columns, coded, into=codec.columns(into) if into is not None else None)


def _values(flat: pa.Array, dtype: np.dtype[Any]) -> np.ndarray:
    """Return the values of an array of Arrow without empty places; its own `to_numpy` imports pandas, which takes long.

    Args:
      flat: numbers or booleans.
      dtype: their type, which is that of `flat`.
    """
    first, count, data = flat.offset, len(flat), flat.buffers()[1]
    if dtype.kind == "b":
        bits = np.unpackbits(np.frombuffer(data, np.uint8), count=first + count, bitorder="little")
        return bits[first:].view(bool)
    return np.frombuffer(data, dtype, count=count, offset=first * dtype.itemsize)
