"""The only owner of the data set format.

A data set is a folder of Parquet shards and a `manifest.json`. Every column is a leaf of an episode
struct, flattened, and quantized as `codec` says; its shape, dtype and quantum, the schema version, the kind,
the config and the versions of the packages that made it stand in the shard's own metadata. A shard is
written under a temporary name, synced and renamed, so a file with a shard's name is whole or was damaged
later, which its SHA-256 shows.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
import pathlib
from typing import Any, TypeAlias

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dipn_jax import files, structs
from dipn_jax.errors import UserError
from dipn_jax.storage import codec


class DamagedShard(UserError):
    """A file that was a shard, or has a shard's name, and cannot be read as one."""


SCHEMA_VERSION = 2
COMPRESSION = 9
"""Level of zstd: bytes of one place of all numbers stand together, which takes it a few milliseconds a shard."""
Episodes: TypeAlias = structs.PushEpisode | structs.GraspEpisode | structs.SettledScene
KINDS: dict[str, type] = {
    "push": structs.PushEpisode,
    "grasp": structs.GraspEpisode,
    "images": structs.SettledScene,
}
MANIFEST = "manifest.json"
_META = b"dipn_jax"


def shard_path(folder: pathlib.Path, index: int) -> pathlib.Path:
    """Where shard `index` of a data set lies."""
    return folder / f"shard-{index:05d}.parquet"


def _columns(episodes: Any) -> dict[str, np.ndarray]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(episodes)
    return {jax.tree_util.keystr(path).lstrip("."): np.asarray(leaf) for path, leaf in leaves}


def write_shard(
    folder: pathlib.Path, index: int, episodes: Episodes, *, kind: str, config: Any, faults: dict[str, Any]
) -> None:
    """Write one shard.

    Args:
      folder: the data set.
      index: the shard's number.
      episodes: a struct of `KINDS[kind]` with a leading `[B]` axis.
      kind: a key of KINDS.
      config: JSON-able: what made it, the seed included.
      faults: what was counted on the way.
    """
    columns, coded = codec.encode(_columns(episodes))
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
        "versions": files.package_versions(),
    }
    table = pa.Table.from_arrays(arrays, names=list(columns))
    table = table.replace_schema_metadata({_META: json.dumps(meta).encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(
        table,
        sink,
        compression="zstd",
        compression_level=COMPRESSION,
        use_dictionary=False,
        column_encoding={f"{name}.list.element": "BYTE_STREAM_SPLIT" for name in coded},
        write_page_checksum=True,
    )
    files.write_atomically(shard_path(folder, index), sink.getvalue().to_pybytes())


def read_meta(path: pathlib.Path) -> dict[str, Any]:
    """A shard's own account of itself.

    Raises:
      UserError: the file is missing, damaged, not a shard, or of another schema version.
    """
    try:
        meta = json.loads(pq.read_schema(path).metadata[_META])
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
    """Episodes in a shard."""
    read_meta(path)
    return pq.read_metadata(path).num_rows


def read_shard(path: pathlib.Path, *, kind: str) -> Any:
    """The episodes of a shard: a struct of `KINDS[kind]` with a leading `[B]` axis, numpy.

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
    return _assemble(KINDS[kind], codec.decode(columns, coded))


def _assemble(struct: type, columns: dict[str, np.ndarray], prefix: str = "") -> Any:
    nested = {"scene": structs.Scene, "push": structs.Push, "grasp": structs.Grasp}
    values = {}
    for field in dataclasses.fields(struct):
        name = prefix + field.name
        values[field.name] = (
            _assemble(nested[field.name], columns, f"{name}.") if field.name in nested else columns[name]
        )
    return struct(**values)


def update_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """Account for every readable shard of the folder in `manifest.json`; returns it.

    Entries of shards that are gone are dropped; a shard that is listed already is not read again. Workers that
    share the folder take turns.
    """
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _rebuild_manifest(folder)


def _rebuild_manifest(folder: pathlib.Path) -> dict[str, Any]:
    known = _read_manifest(folder)["shards"] if (folder / MANIFEST).exists() else {}
    shards: dict[str, Any] = {}
    for path in sorted(folder.glob("shard-*.parquet")):
        entry = known.get(path.name)
        if entry is None or entry["bytes"] != path.stat().st_size:
            meta = read_meta(path)
            entry = {
                "episodes": count(path),
                "bytes": path.stat().st_size,
                "sha256": files.file_sha256(path),
                "kind": meta["kind"],
                "faults": meta["faults"],
            }
        shards[path.name] = entry
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "kind": next((entry["kind"] for entry in shards.values()), None),
        "episodes": sum(entry["episodes"] for entry in shards.values()),
        "shards": shards,
    }
    files.write_json(folder / MANIFEST, manifest)
    return manifest


def _read_manifest(folder: pathlib.Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text())
        for entry in manifest["shards"].values():
            if not {"bytes", "sha256", "episodes", "faults"} <= set(entry):
                raise KeyError
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"data set {folder}: no {MANIFEST}; give a folder that dipn-datagen wrote") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UserError(f"data set {folder}: {MANIFEST} is damaged; run dipn-datagen repair {folder}") from None
    return manifest


def verify(folder: pathlib.Path) -> list[tuple[pathlib.Path, str]]:
    """Shards that are missing, damaged or unlisted, each with what is wrong; empty if all is well."""
    manifest, problems = _read_manifest(folder), []
    for name, entry in manifest["shards"].items():
        path = folder / name
        if not path.exists():
            problems.append((path, "missing"))
        elif path.stat().st_size != entry["bytes"]:
            problems.append((path, f"{path.stat().st_size} bytes, want {entry['bytes']}"))
        elif files.file_sha256(path) != entry["sha256"]:
            problems.append((path, "SHA-256 differs from the manifest's"))
        else:
            read_meta(path)  # of this schema version
    listed = set(manifest["shards"])
    problems += [(p, "not in the manifest") for p in sorted(folder.glob("shard-*.parquet")) if p.name not in listed]
    return problems


def repair(folder: pathlib.Path) -> list[pathlib.Path]:
    """Set damaged shards aside as `*.damaged`, and rebuild the manifest from the rest; returns what was set aside.

    Raises:
      UserError: the folder is no data set, or holds shards of another schema version, which are not damaged.
    """
    if not (folder / "config.json").is_file() and not (folder / MANIFEST).is_file():
        raise UserError(f"data set {folder}: no such data set; give a folder that dipn-datagen wrote")
    try:
        known = _read_manifest(folder)["shards"]
    except UserError:
        known = {}
    removed = []
    for path in sorted(folder.glob("shard-*.parquet")):
        try:
            read_shard(path, kind=read_meta(path)["kind"])
            good = path.name not in known or files.file_sha256(path) == known[path.name]["sha256"]
        except DamagedShard:
            good = False
        if not good:
            path.rename(path.with_suffix(".parquet.damaged"))
            removed.append(path)
    (folder / MANIFEST).unlink(missing_ok=True)
    update_manifest(folder)
    return removed


def summary(folder: pathlib.Path) -> dict[str, Any]:
    """What a data set holds: counts, bytes, faults, and the config and versions of its first shard."""
    manifest = _read_manifest(folder)
    faults: dict[str, int] = {}
    for entry in manifest["shards"].values():
        for name, count in entry["faults"].items():
            faults[name] = faults.get(name, 0) + count
    first = next(iter(manifest["shards"]), None)
    meta = read_meta(folder / first) if first else {}
    return {
        "kind": manifest["kind"],
        "episodes": manifest["episodes"],
        "shards": len(manifest["shards"]),
        "bytes": sum(entry["bytes"] for entry in manifest["shards"].values()),
        "faults": faults,
        "config": meta.get("config"),
        "versions": meta.get("versions"),
    }


def load(folder: pathlib.Path, *, kind: str) -> tuple[Any, str]:
    """A whole data set in memory (a few kilobytes an episode), after checking every shard.

    Args:
      folder: the data set.
      kind: a key of KINDS.

    Returns:
      The episodes `[B, ...]` in the order of the shards, and a fingerprint of the data set.

    Raises:
      UserError: no such data set, a shard is missing or damaged, or it holds another kind.
    """
    manifest = _read_manifest(folder)
    problems = verify(folder)
    if problems:
        path, what = problems[0]
        raise UserError(
            f"data set {folder}: {path.name} {what} ({len(problems)} of {len(manifest['shards'])} shards wrong); "
            f"run dipn-datagen repair {folder}, then generate again"
        )
    if not manifest["shards"]:
        raise UserError(f"data set {folder}: no shards; generate some with dipn-datagen {kind} --out {folder}")
    shards = [read_shard(folder / name, kind=kind) for name in manifest["shards"]]
    widths = {shard.scene.shape.shape[1] for shard in shards}
    if len(widths) > 1:
        raise UserError(f"data set {folder}: shards with {sorted(widths)} object slots; want one number in a folder")
    episodes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *shards)
    text = json.dumps([entry["sha256"] for entry in manifest["shards"].values()])
    return episodes, hashlib.sha256(text.encode()).hexdigest()
