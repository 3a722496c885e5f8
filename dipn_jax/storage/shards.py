"""Shards of a data set: Parquet files of episodes. Only this module reads and writes them.

Every column is a leaf of an episode struct, flattened, and quantized as `codec` says; its shape, dtype and quantum,
the schema version, the kind, the config and the versions of the packages that made it are in the shard's own metadata.
A shard is written under a temporary name, synced and renamed, so a file with a shard's name is whole or was damaged
later, which its SHA-256 in the manifest (`records`) shows.
"""

from __future__ import annotations

import json
import pathlib
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dipn_jax import files, structs
from dipn_jax.errors import UserError
from dipn_jax.storage import codec

SCHEMA_VERSION = 2
"""Version of the format; shards of another version are refused."""
COMPRESSION_LEVEL = 9
"""Level of zstd; it takes a few milliseconds a shard, because bytes of the same place of all numbers are neighbours."""
KINDS: dict[str, type] = {
    "push": structs.PushEpisode,
    "grasp": structs.GraspEpisode,
    "images": structs.SettledScene,
}
"""Kinds of data sets, and the struct of their episodes."""
ROUNDED_START = "rounded"
"""Entry `start` of the metadata: episodes were simulated from what is stored, so they can be simulated again exactly.

Shards without it are older: their episodes began within half a quantum of what is stored, and contact amplifies that.
"""
_META_KEY = b"dipn_jax"
"""Key of our entry in the metadata of a shard."""


class DamagedShard(UserError):
    """A file that was a shard, or has a shard's name, and cannot be read as one."""


def shard_path(folder: pathlib.Path, index: int) -> pathlib.Path:
    """Return the path of shard `index` of a data set."""
    return folder / f"shard-{index:05d}.parquet"


def write_shard(
    folder: pathlib.Path, index: int, episodes: Any, *, kind: str, config: Any, faults: dict[str, Any]
) -> None:
    """Write one shard.

    Args:
      folder: the data set.
      index: the shard's number.
      episodes: a struct of `KINDS[kind]` with a leading `[B]` axis.
      kind: a key of KINDS.
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
    files.write_atomically(shard_path(folder, index), sink.getvalue().to_pybytes())


def read_meta(path: pathlib.Path) -> dict[str, Any]:
    """Return the metadata of a shard.

    Raises:
      UserError: the file is missing, damaged, not a shard, or of another schema version.
    """
    try:
        meta = json.loads(pq.read_schema(path).metadata[_META_KEY])
    except FileNotFoundError:
        raise UserError(f"shard {path}: not found; generate it again with dipn-datagen") from None
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError):
        raise DamagedShard(
            f"shard {path}: truncated, damaged or not a shard of this project; run dipn-datagen repair {path.parent}"
        ) from None
    if meta["schema_version"] != SCHEMA_VERSION:
        raise UserError(
            f"shard {path}: schema version {meta['schema_version']}, want {SCHEMA_VERSION}; generate it anew elsewhere"
        )
    return meta


def count(path: pathlib.Path) -> int:
    """Return the number of episodes in a shard."""
    read_meta(path)
    return pq.read_metadata(path).num_rows


def read_shard(path: pathlib.Path, *, kind: str) -> Any:
    """Return the episodes of a shard: a struct of `KINDS[kind]` with a leading `[B]` axis, NumPy arrays.

    Raises:
      UserError: see `read_meta`; or the shard is of another kind.
    """
    meta = read_meta(path)
    if meta["kind"] != kind:
        raise UserError(f"shard {path}: holds {meta['kind']} episodes, want {kind}; give another folder")
    try:
        table = pq.read_table(path, page_checksum_verification=True)
    except (pa.ArrowException, OSError):
        raise DamagedShard(f"shard {path}: damaged; run dipn-datagen repair {path.parent}") from None
    columns = {}
    for name, spec in meta["columns"].items():
        flat = table.column(name).combine_chunks().flatten().to_numpy(zero_copy_only=False)
        columns[name] = flat.astype(spec["dtype"]).reshape(len(table), *spec["shape"])
    coded = {name: spec for name, spec in meta["columns"].items() if "quantum" in spec}
    return codec.assemble(KINDS[kind], codec.decode(columns, coded))
