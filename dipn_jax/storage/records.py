"""Data sets: folders of shards (`shards`) with a `manifest.json` that lists them and their SHA-256."""

from __future__ import annotations

import functools
import hashlib
import json
import pathlib
from typing import Any

import jax
import numpy as np

from dipn_jax import console, files, typed
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, layout, shards
from dipn_jax.structs import GraspEpisode, PushEpisode, SettledScene

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

MANIFEST = "manifest.json"
"""Name of the file that lists the shards of a data set."""
UNLISTED = "is not listed in the manifest yet"
"""What `verify` says of a shard that was copied into the folder."""
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


def update_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """List every readable shard of the folder in `manifest.json`, and return the manifest.

    Entries of missing shards are dropped; a shard that is listed already is not read again. Workers that share the
    folder take turns, where the system can lock files. Where it cannot, the last one to write looks again whether
    shards were added while it wrote, so that none stays unlisted.
    """
    with (folder / ".lock").open("wb") as lock:
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:
            _warn_of_no_locks(folder)
        manifest = _rebuild_manifest(folder)
        while set(manifest["shards"]) != {path.name for path in shards.shard_files(folder)}:
            manifest = _rebuild_manifest(folder)  # somebody whom no lock kept waiting has added a shard
        return manifest


@functools.cache
def _warn_of_no_locks(folder: pathlib.Path) -> None:
    """Say once a process that workers cannot take turns."""
    console.warn(f"{folder}: its file system has no locks; workers list their shards without taking turns")


def _rebuild_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """Write the manifest anew, as `update_manifest` says, and return it."""
    known = _read_manifest(folder)["shards"] if (folder / MANIFEST).exists() else {}
    entries: dict[str, Any] = {}
    for path in shards.shard_files(folder):
        entry = known.get(path.name)
        if entry is None or entry["bytes"] != path.stat().st_size:
            meta = shards.read_meta(path)
            entry = {
                "episodes": meta["episodes"],
                "bytes": path.stat().st_size,
                "sha256": files.file_sha256(path),
                "kind": meta["kind"],
                "faults": meta["faults"],
            }
        entries[path.name] = entry
    manifest = {
        "schema_version": shards.SCHEMA_VERSION,
        "kind": next((entry["kind"] for entry in entries.values()), None),
        "episodes": sum(entry["episodes"] for entry in entries.values()),
        "shards": entries,
    }
    files.write_json(folder / MANIFEST, manifest)
    return manifest


def _read_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """Return the manifest of a data set; raise UserError if it is missing or damaged."""
    path = folder / MANIFEST
    try:
        manifest: dict[str, Any] = typed.check(typed.parse(path.read_bytes()), _FORM)
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


def _problem(path: pathlib.Path, entry: dict[str, Any]) -> str:
    """Return what is wrong with a shard that the manifest lists so; an empty text if nothing is."""
    if not path.is_file():
        return "missing"
    if path.stat().st_size != entry["bytes"]:
        return f"{path.stat().st_size} bytes, want {entry['bytes']}"
    if files.file_sha256(path) != entry["sha256"]:
        return "SHA-256 differs from the manifest's"
    try:
        meta = shards.read_meta(path)  # of this schema version
    except shards.DamagedShard as error:
        return error.what
    if (meta["episodes"], meta["kind"]) != (entry["episodes"], entry["kind"]):
        return f"{meta['episodes']} {meta['kind']} episodes, want {entry['episodes']} {entry['kind']}"
    return ""


def verify(folder: pathlib.Path) -> list[tuple[pathlib.Path, str]]:
    """Return the shards that are missing, damaged or unlisted, each with what is wrong; empty if none is."""
    listed = _read_manifest(folder)["shards"]
    checked = [(folder / name, _problem(folder / name, entry)) for name, entry in listed.items()]
    unlisted = [(path, UNLISTED) for path in shards.shard_files(folder) if path.name not in listed]
    return [(path, what) for path, what in checked if what] + unlisted


def repair(folder: pathlib.Path) -> list[pathlib.Path]:
    """Rename damaged shards to `*.damaged`, rebuild the manifest from the rest, and return the paths of the former.

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
    for path in shards.shard_files(folder):
        if not _good(path, known.get(path.name)):
            files.move(path, path.with_suffix(".parquet.damaged"))
            removed.append(path)
    (folder / MANIFEST).unlink(missing_ok=True)
    update_manifest(folder)
    return removed


def _good(path: pathlib.Path, entry: dict[str, Any] | None) -> bool:
    """Return whether a shard can be read to its end, and is the one that the manifest lists, if it lists one."""
    try:
        if not path.is_file() or (entry is not None and files.file_sha256(path) != entry["sha256"]):
            return False
        shards.read_shard(path, kind=shards.read_meta(path)["kind"])
    except shards.DamagedShard:
        return False
    return True


def summary(folder: pathlib.Path) -> dict[str, Any]:
    """Describe a data set: counts, bytes, faults, who made it, and the config and versions of its first shard.

    `asked` is the number of episodes that were asked for, and `missing` says in one line what is not there of them;
    both are None where nothing is known. `made_by` lists every combination of versions and kind of processor,
    `merged` what was joined to a merged data set.
    """
    manifest = _read_manifest(folder)
    entries = manifest["shards"]
    metas = [shards.read_meta(folder / name) for name in entries]
    faults: dict[str, int] = {}
    for entry in entries.values():
        for name, count in entry["faults"].items():
            faults[name] = faults.get(name, 0) + count
    held = accounting.held(entries)
    asked = accounting.asked(folder)
    return {
        "kind": manifest["kind"],
        "episodes": sum(held.values()),
        "asked": asked and asked.episodes,
        "missing": accounting.missing(folder, held),
        "shards": len(entries),
        "bytes": sum(entry["bytes"] for entry in entries.values()),
        "faults": faults,
        "config": metas[0]["config"] if metas else None,
        "versions": metas[0]["versions"] if metas else None,
        "merged": accounting.merged(folder),
        "made_by": accounting.makers(metas),
    }


def missing(folder: pathlib.Path) -> str | None:
    """Say in one line which of the episodes that were asked for are not there; None where all are.

    Raises:
      UserError: there is no data set, or what was asked for cannot be read.
    """
    return accounting.missing(folder, accounting.held(_read_manifest(folder)["shards"]))


def read_episodes(folder: pathlib.Path | str) -> PushEpisode | GraspEpisode | SettledScene:
    """Read a whole data set: a PushEpisode, GraspEpisode or SettledScene with a leading `[B]`, as numpy.

    Example:
      pushes = dipn_jax.read_episodes("data/push")
      pushes.poses.shape                                       # [B, 11, N, 7]: at every centimetre of each push
      observation = dipn_jax.render(pushes.scene[0], pushes.poses[0, 0])

    Args:
      folder: what `dipn-datagen push`, `grasp` or `images` wrote.

    Raises:
      UserError: there is no data set, or a shard of it is damaged.
    """
    folder = files.absolute(folder)
    episodes: PushEpisode | GraspEpisode | SettledScene
    episodes, _ = load(folder, kind=str(summary(folder)["kind"]))
    return episodes


def load(folder: pathlib.Path, *, kind: str) -> tuple[Any, str]:
    """Load a whole data set into memory (a few kilobytes an episode), after checking every shard.

    Where episodes that were asked for have not been made, one line says so.

    Args:
      folder: the data set.
      kind: a key of `layout.KINDS`.

    Returns:
      The episodes `[B, ...]` in the order of the shards, and a fingerprint of the data set.

    Raises:
      UserError: no such data set, a shard is missing or damaged, or it holds another kind.
    """
    manifest = checked(folder, kind=kind)
    parts = [shards.read_shard(folder / name, kind=kind) for name in manifest["shards"]]
    widths = {part.scene.shape.shape[1] for part in parts}
    if len(widths) > 1:
        raise UserError(f"data set {folder}: shards with {sorted(widths)} object slots; want one number in a folder")
    episodes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return episodes, fingerprint(manifest)


def fingerprint(manifest: dict[str, Any]) -> str:
    """Return a fingerprint of the data set that has this manifest: it follows from the content of the shards."""
    return hashlib.sha256(json.dumps([entry["sha256"] for entry in manifest["shards"].values()]).encode()).hexdigest()


def checked(folder: pathlib.Path, *, kind: str) -> dict[str, Any]:
    """Return the manifest of a data set after checking every shard; it lists one at least.

    Where episodes that were asked for have not been made, one line says so.

    Args:
      folder: the data set.
      kind: of its episodes, for the message that says how to make some.

    Raises:
      UserError: no such data set, or a shard is missing or damaged.
    """
    manifest = whole(folder, kind=kind)
    try:
        said = accounting.missing(folder, accounting.held(manifest["shards"]))
    except UserError as error:  # what was asked for cannot be read; the shards are whole all the same
        said = str(error)
    if said:
        console.warn(said)
    return manifest


def whole(folder: pathlib.Path, *, kind: str) -> dict[str, Any]:
    """Return the manifest as `checked` does, whatever is missing of what was asked for."""
    manifest = _read_manifest(folder)
    if problems := verify(folder):
        number = f"{len(problems)} of {max(len(manifest['shards']), len(problems))} shards"
        raise UserError(
            f"data set {folder}: {problems[0][0].name} {problems[0][1]} ({number}); {advice(folder, problems)}"
        )
    if not manifest["shards"]:
        raise UserError(f"data set {folder}: no shards; generate some with dipn-datagen {kind} --out {folder}")
    return manifest


def advice(folder: pathlib.Path, problems: list[tuple[pathlib.Path, str]]) -> str:
    """Return what is to be done about what `verify` has found."""
    if all(what == UNLISTED for _, what in problems):
        return f"if you copied them there, run dipn-datagen merge {folder}"
    return f"run dipn-datagen repair {folder}, then generate again"
