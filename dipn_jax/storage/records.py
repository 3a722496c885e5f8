"""Data sets: folders of shards (`shards`), most of which a manifest lists (`manifest`)."""

from __future__ import annotations

import concurrent.futures
import hashlib
import json
import pathlib
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, manifest, mirror, shards
from dipn_jax.storage.manifest import MANIFEST
from dipn_jax.storage.on_demand import DataSet, Episodes, Shard
from dipn_jax.storage.space import Space
from dipn_jax.structs import GraspEpisode, PushEpisode, SettledScene
from dipn_jax.system import files, machine

Problems = list[tuple[pathlib.Path, str]]
"""Shards, each with what is wrong with it."""
Look = tuple[str, dict[str, Any] | None]
"""What is wrong with a shard, an empty text if nothing is; and then its metadata."""
Metas = dict[pathlib.Path, dict[str, Any]]
"""The metadata of shards."""


def _look(path: pathlib.Path, entry: dict[str, Any]) -> Look:
    """Check a shard against its manifest entry; return the problem, or '' and its metadata."""
    if not path.is_file():
        return "missing", None
    if path.stat().st_size != entry["bytes"]:
        return f"{path.stat().st_size} bytes, want {entry['bytes']}", None
    if files.file_sha256(path) != entry["sha256"]:
        return "SHA-256 differs from the manifest's", None
    try:
        meta = shards.read_meta(path)  # of this schema version
    except shards.DamagedShard as error:
        return error.what, None
    if (meta["episodes"], meta["kind"]) != (entry["episodes"], entry["kind"]):
        return f"{meta['episodes']} {meta['kind']} episodes, want {entry['episodes']} {entry['kind']}", None
    return "", meta


def _look_through(path: pathlib.Path) -> Look:
    """Read a shard to its end; return the problem, or '' and its metadata."""
    if not path.is_file():
        return "missing", None
    try:
        meta = shards.read_meta(path)
        shards.read_shard(path, kind=meta["kind"])
    except shards.DamagedShard as error:
        return error.what, None
    return "", meta


def verify(folder: pathlib.Path) -> Problems:
    """Return the shards that are missing or damaged, each with what is wrong; empty if none is.

    Those that the manifest does not list are read to their end.
    """
    return verify_with_makers(folder)[0]


def verify_with_makers(folder: pathlib.Path) -> tuple[Problems, str | None]:
    """Return what `verify` does, and in one line what differs between those who made the shards that are whole."""
    return _said(folder, _looks(folder))


def _looks(folder: pathlib.Path) -> list[tuple[pathlib.Path, Look]]:
    """Look at every shard of a data set."""
    listed = manifest.listed(folder)
    paths = [folder / name for name in listed]
    with concurrent.futures.ThreadPoolExecutor(machine.cores()) as pool:
        looks = list(zip(paths, pool.map(_look, paths, listed.values()), strict=True))
    looks += [(path, _look_through(path)) for path in manifest.unlisted(folder, listed)]
    return _of_one_kind(looks)


def _said(folder: pathlib.Path, looks: list[tuple[pathlib.Path, Look]]) -> tuple[Problems, str | None]:
    """Return what `verify_with_makers` does, of what was seen."""
    mixed = accounting.describe_mixed_makers(accounting.makers([meta for _, (_, meta) in looks if meta is not None]))
    return [(path, what) for path, (what, _) in looks if what], mixed and f"{folder}: {mixed}"


def _of_one_kind(looks: list[tuple[pathlib.Path, Look]]) -> list[tuple[pathlib.Path, Look]]:
    """Mark shards of a minority kind as wrong, as when somebody copied them in."""
    kinds = [meta["kind"] for _, (_, meta) in looks if meta is not None]
    most = max(kinds, key=kinds.count, default=None)
    return [
        (path, (f"holds {meta['kind']} episodes among {most} episodes", None))
        if meta is not None and meta["kind"] != most
        else (path, (what, meta))
        for path, (what, meta) in looks
    ]


def repair(folder: pathlib.Path) -> list[pathlib.Path]:
    """Rename damaged shards to `*.damaged`, rebuild the manifest from the rest, and return the paths of the former.

    Raises:
      UserError: the folder is no data set, or holds shards of another schema version, which are not damaged.
    """
    if not (folder / "config.json").is_file() and not (folder / MANIFEST).is_file():
        raise UserError(f"data set {folder}: no such data set; give a folder that dipn-datagen wrote")
    try:
        known = manifest.listed(folder)
    except UserError:
        known = {}
    removed = []
    looks = [(path, _check_listed(path, known.get(path.name))) for path in shards.shard_files(folder)]
    for path, (what, _) in _of_one_kind(looks):
        if what:
            files.move(path, path.with_suffix(".parquet.damaged"))
            removed.append(path)
    (folder / MANIFEST).unlink(missing_ok=True)
    manifest.update_manifest(folder)
    return removed


def _check_listed(path: pathlib.Path, entry: dict[str, Any] | None) -> Look:
    """Check that a shard is the one that the manifest lists, and read it to its end; return as `_look` does."""
    if entry is not None and (not path.is_file() or files.file_sha256(path) != entry["sha256"]):
        return "not the one that the manifest lists", None
    return _look_through(path)


def summary(folder: pathlib.Path) -> dict[str, Any]:
    """Describe a data set: counts, bytes, faults, who made it, and the config and versions of its first shard.

    `asked` is the number of episodes that were asked for, and `missing` says in one line what is not there of them;
    both are None where nothing is known. `made_by` lists every combination of versions and kind of processor,
    `merged` what was joined to a merged data set.
    """
    found = manifest.entries(folder)
    metas = [shards.read_meta(folder / name) for name in found]
    faults: dict[str, int] = {}
    for entry in found.values():
        for name, count in entry["faults"].items():
            faults[name] = faults.get(name, 0) + count
    held = accounting.episodes_by_shard(found)
    asked = accounting.requested_size(folder)
    return {
        "kind": next((entry["kind"] for entry in found.values()), None),
        "episodes": sum(held.values()),
        "asked": asked and asked.episodes,
        "missing": accounting.missing(folder, held),
        "shards": len(found),
        "bytes": sum(entry["bytes"] for entry in found.values()),
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
    listed = manifest.listed(folder)
    others = {path.name: {"episodes": shards.count(path)} for path in manifest.unlisted(folder, listed)}
    return accounting.missing(folder, accounting.episodes_by_shard(listed | others))


def read_episodes(folder: pathlib.Path | str) -> PushEpisode | GraspEpisode | SettledScene:
    """Read a whole data set: a PushEpisode, GraspEpisode or SettledScene with a leading `[B]`, as numpy.

    Example:
      pushes = dipn_jax.read_episodes("data/push")
      pushes.poses.shape                                       # [B, 11, N, 7]: at every centimetre of each push
      observation = dipn_jax.render(pushes.scene[0], pushes.poses[0, 0])

    Args:
      folder: what `dipn-datagen push`, `grasp` or `images` wrote, or its URL.

    Raises:
      UserError: there is no data set, or a shard of it is damaged.
    """
    folder = mirror.local(folder)
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
      UserError: as `opened`; or a shard cannot be read.
    """
    found = opened(folder, kind=kind)
    return Episodes([(found, range(len(found)))], Space()).whole(), found.fingerprint


def opened(folder: pathlib.Path, *, kind: str) -> DataSet:
    """Check every shard of a data set and return it; none of its episodes is read.

    Args:
      folder: the data set.
      kind: a key of `layout.KINDS`.

    Raises:
      UserError: no such data set, a shard is missing or damaged, or it holds another kind, or shards have different
        numbers of object slots.
    """
    entries, metas = _checked(folder, kind=kind)
    found: list[Shard] = []
    for name, entry in entries.items():
        path = folder / name
        meta = metas.get(path) or shards.read_meta(path)  # of one that has come since
        shards.require_kind(path, meta, kind)
        first = found[0].meta if found else meta
        if shards.slots(meta) != shards.slots(first):
            few, many = sorted(map(shards.slots, (meta, first)))
            said = f"shards with {few} and {many} object slots; want one number in a folder"
            raise UserError(f"data set {folder}: {said}")
        columns = first["columns"] if meta["columns"] == first["columns"] else meta["columns"]  # kept once
        found.append(Shard(path, entry["sha256"], {"columns": columns, "episodes": meta["episodes"]}))
    return DataSet(kind, tuple(found), shards.empty(kind, found[0].meta), fingerprint(entries))


def fingerprint(entries: dict[str, Any]) -> str:
    """Return a fingerprint of the data set that has these shards: it follows from their content."""
    return hashlib.sha256(json.dumps([entry["sha256"] for entry in entries.values()]).encode()).hexdigest()


def _checked(folder: pathlib.Path, *, kind: str) -> tuple[dict[str, Any], Metas]:
    """Return entries and metadata as `_whole` does, and say where makers differ and what was asked for but not made."""
    found, metas, mixed = _whole(folder, kind=kind)
    if mixed:
        console.warn(mixed)
    try:
        said = accounting.missing(folder, accounting.episodes_by_shard(found))
    except UserError as error:  # what was asked for cannot be read; the shards are whole all the same
        said = str(error)
    if said:
        console.warn(said)
    return found, metas


def checked_entries(folder: pathlib.Path, *, kind: str) -> dict[str, Any]:
    """Return the entry of every shard of a data set, which has one at least, after checking each.

    Args:
      folder: the data set.
      kind: of its episodes, for the message that says how to make some.

    Raises:
      UserError: no such data set, or a shard is missing or damaged.
    """
    return _whole(folder, kind=kind)[0]


def _whole(folder: pathlib.Path, *, kind: str) -> tuple[dict[str, Any], Metas, str | None]:
    """Return entries and metadata of a data set, and what differs between those who made it; see `checked_entries`."""
    looks = _looks(folder)
    problems, mixed = _said(folder, looks)
    if problems:
        path, what = problems[0]
        raise UserError(
            f"data set {folder}: {path.name} {what} ({len(problems)} shards wrong in all); "
            f"run dipn-datagen repair {folder}, then generate again"
        )
    found = manifest.entries(folder)
    if not found:
        raise UserError(f"data set {folder}: no shards; generate some with dipn-datagen {kind} --out {folder}")
    return found, {path: meta for path, (_, meta) in looks if meta is not None}, mixed
