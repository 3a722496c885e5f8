"""The list of a data set's shards: `manifest.json`, with their sizes and SHA-256.

It is a function of the shards, and is written when generation ends: by the only worker, or by each that finds all
shards there. While generation runs, or where it was killed, there are shards that the manifest does not list: readers
look for them and read them, too.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import pathlib
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import layout, shards
from dipn_jax.system import files, machine, typed

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

MANIFEST = "manifest.json"
"""Name of the file that lists the shards of a data set."""
SILENT_SHARDS = 20
"""Number of shards below which no progress is shown while they are looked at."""
_FORM = {
    "kind": typed.Maybe(set(layout.KINDS)),
    "shards": {
        str: {
            "episodes": typed.Whole(1),
            "bytes": typed.Whole(),
            "sha256": str,
            "kind": set(layout.KINDS),
            "faults": {str: typed.Whole()},
        }
    },
}
"""Form of the manifest."""


def update_manifest(folder: pathlib.Path, *, made: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """List every readable shard of the folder in `manifest.json`, and return the manifest.

    Entries of missing shards are dropped; a shard that is listed already is not read again. Workers that share the
    folder take turns, where the system can lock files. Where it cannot, the last one to write looks again whether
    shards were added while it wrote, so that none stays unlisted.

    Args:
      folder: the data set.
      made: entries by name, as `shards.write_shard` returns them: of shards that need not be read for it.
    """
    with _file_lock(folder) as alone:
        manifest = _rebuild(folder, made or {})
        while not alone and set(manifest["shards"]) != {path.name for path in shards.shard_files(folder)}:
            manifest = _rebuild(folder, made or {})  # somebody whom no lock kept waiting has added a shard
        return manifest


def update_whole(folder: pathlib.Path, *, made: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, Any] | None:
    """Do as `update_manifest` if the data set is whole; else write nothing and return None.

    Args:
      folder: the data set.
      made: entries by name, as for `update_manifest`.
      sizes: episodes of every shard that was asked for, by name: one that is to be made longer is still missing.
    """
    with _file_lock(folder):
        entries = _entries(folder, made)
        return write(folder, entries) if holds(entries, sizes) else None


def holds(entries: Mapping[str, Any], sizes: Mapping[str, int]) -> bool:
    """Return whether all these shards are among the entries, each with as many episodes as `sizes` says."""
    return all(name in entries and entries[name]["episodes"] == size for name, size in sizes.items())


def forget(folder: pathlib.Path, names: Collection[str]) -> None:
    """Take shards out of the manifest that are about to be made anew; it is left alone if it lists none of them."""
    if not (folder / MANIFEST).exists():
        return
    with _file_lock(folder):
        known = _read(folder)["shards"]
        if not known.keys().isdisjoint(names):
            write(folder, {name: entry for name, entry in known.items() if name not in names})


@contextlib.contextmanager
def _file_lock(folder: pathlib.Path) -> Iterator[bool]:
    """Wait until no other worker writes the manifest; yield whether that is certain, as files can be locked."""
    with (folder / ".lock").open("wb") as lock:
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
            alone = fcntl is not None
        except OSError:
            _warn_of_no_locks(folder)
            alone = False
        yield alone


@functools.cache
def _warn_of_no_locks(folder: pathlib.Path) -> None:
    """Warn, once a process, that workers cannot take turns."""
    console.warn(f"{folder}: its file system has no locks; workers list their shards without taking turns")


def _rebuild(folder: pathlib.Path, made: Mapping[str, Any]) -> dict[str, Any]:
    """Write the manifest anew, as `update_manifest` says, and return it."""
    return write(folder, _entries(folder, made))


def _entries(folder: pathlib.Path, made: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of every shard that is there, by name and in order; those that are not known are read."""
    known = (_read(folder)["shards"] if (folder / MANIFEST).exists() else {}) | dict(made)
    paths = shards.shard_files(folder)
    todo = [path for path in paths if path.name not in known or known[path.name]["bytes"] != path.stat().st_size]
    with (
        console.Progress("look", len(todo), unit="shards", quiet=len(todo) < SILENT_SHARDS) as progress,
        concurrent.futures.ThreadPoolExecutor(machine.cores()) as pool,
    ):
        for path, entry in zip(todo, pool.map(shards.entry, todo), strict=True):
            known[path.name] = entry
            progress.advance(1)
    return {path.name: known[path.name] for path in paths}


def write(folder: pathlib.Path, entries: dict[str, Any]) -> dict[str, Any]:
    """Write a manifest that lists these shards, and return it."""
    manifest = {
        "schema_version": shards.SCHEMA_VERSION,
        "kind": next((entry["kind"] for entry in entries.values()), None),
        "episodes": sum(entry["episodes"] for entry in entries.values()),
        "shards": entries,
    }
    files.write_json(folder / MANIFEST, manifest)
    return manifest


def _read(folder: pathlib.Path) -> dict[str, Any]:
    """Return the manifest of a data set; raise UserError if it is missing or damaged."""
    path = folder / MANIFEST
    try:
        manifest: dict[str, Any] = typed.check(typed.parse(files.read_bytes(path)), _FORM)
        for name in manifest["shards"]:
            if "/" in name or not (name.startswith("shard-") and name.endswith(".parquet")):
                raise typed.Misfit(f"{typed.brief(name)} is no name of a shard")
            typed.inside(folder, name)
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"data set {folder}: no {MANIFEST}; give a folder that dipn-datagen wrote") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); mend that, or give another folder") from None
    except typed.Misfit as error:
        raise UserError(
            f"data set {folder}: {MANIFEST} is damaged; run dipn-datagen repair {folder} ({error})"
        ) from None
    return manifest


def listed(folder: pathlib.Path) -> dict[str, Any]:
    """Return what the manifest lists; nothing if generation has begun and no manifest is written yet."""
    if not (folder / MANIFEST).exists() and (folder / "config.json").is_file():
        return {}
    return dict(_read(folder)["shards"])


def unlisted(folder: pathlib.Path, known: Mapping[str, Any]) -> list[pathlib.Path]:
    """Return the shards that the manifest does not list, from a generation that is still running or was killed."""
    return [path for path in shards.shard_files(folder) if path.name not in known]


def entries(folder: pathlib.Path) -> dict[str, Any]:
    """Return an entry for every shard by its name, in order: of those that the manifest lists, and of others.

    Raises:
      UserError: the folder is no data set, its manifest is damaged, or a shard that is not listed.
    """
    known = listed(folder)
    found = known | {path.name: shards.entry(path) for path in unlisted(folder, known)}
    return dict(sorted(found.items()))
