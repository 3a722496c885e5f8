"""Data sets joined to one: their shards, byte for byte, in one place."""

from __future__ import annotations

import json
import pathlib
import urllib.parse
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, manifest, mirror, records, shards
from dipn_jax.storage.objects import Bucket
from dipn_jax.system import addresses, files, typed

from . import joined
from .joined import Entry, Plan

MAX_MESSAGE_CHARS = 400
"""Characters of what differs between two data sets that are shown at most."""


def merge(places: Sequence[pathlib.Path], out: pathlib.Path) -> None:
    """Join data sets.

    Args:
      places: their folders or URLs.
      out: folder of the joined data set, or its URL.

    Raises:
      UserError: one is missing or damaged, they are of several kinds or numbers of slots or have too many shards,
        episodes were made twice, or `out` holds something else or cannot be written to.
    """
    _require_apart(places, out)
    url = addresses.url(out)
    if url is None:
        console.require_out(out)
    elif not url.startswith("file:"):  # of which a folder would be made
        Bucket(url)  # that it cannot be used is said before anything is copied from elsewhere
    sets = {folder: _entries(folder) for folder in map(mirror.local, places)}
    entries = [entry for some in sets.values() for entry in some]
    if len(entries) > shards.MOST_SHARDS:
        raise UserError(
            f"merge: {len(entries)} shards, more than their names can number ({shards.MOST_SHARDS}); leave the data "
            "sets apart: training takes several folders: --data A B"
        )
    _require_one({entry.path: entry.meta["kind"] for entry in entries}, "kind")
    widths = {entry.path: entry.meta["columns"]["scene.shape"]["shape"][0] for entry in entries}
    _require_one(widths, "number of object slots", "; training takes several folders: --data A B")
    _refuse_twice(entries)
    plan = _plan(sets)
    _say(sets, joined.into_folder(plan, out) if url is None else joined.into_bucket(plan, url), url or str(out))


def _require_apart(places: Sequence[pathlib.Path], out: pathlib.Path) -> None:
    """Raise a UserError if two places are the same."""
    named: set[str] = set()
    for place in (*places, out):
        address = addresses.url(place) or str(place)
        folder = urllib.parse.unquote(address.removeprefix("file://")) if address.startswith("file:") else address
        if folder in named:
            raise UserError(f"merge: {address} is named twice; want each folder once")
        named.add(folder)


def _entries(folder: pathlib.Path) -> list[Entry]:
    """Return the shards of a data set, each of which is whole."""
    found = records.checked_entries(folder, kind=str(records.summary(folder)["kind"]))
    paths = {typed.inside(folder, name): entry["sha256"] for name, entry in found.items()}
    return [Entry(path, sha256, shards.read_meta(path)) for path, sha256 in paths.items()]


def _require_one(found: dict[pathlib.Path, Any], what: str, advice: str = "") -> None:
    """Raise a UserError if shards differ in something."""
    (path, value), *others = found.items()
    for other, its in others:
        if its != value:
            raise UserError(
                f"merge: {path.parent} has {what} {value}, {other.parent} has {its}; want one {what}{advice}"
            )


def _refuse_twice(entries: Sequence[Entry]) -> None:
    """Raise a UserError if two shards are equal, or were drawn from the same seed with the same number."""
    seen: dict[str, Entry] = {}
    for entry in entries:
        for key in filter(None, (entry.sha256, entry.scenes)):
            if twin := seen.get(key):
                made = f"both made of seed {entry.meta['config'].get('seed')} with number {entry.meta['shard']}"
                same = "equal" if twin.sha256 == entry.sha256 else made
                raise UserError(
                    f"merge: {twin.path} and {entry.path} are {same}: the same scenes twice; leave one of them out, or "
                    "make it with another --seed"
                )
            seen[key] = entry


def _plan(sets: dict[pathlib.Path, list[Entry]]) -> Plan:
    """Return what the joined data set is.

    Data sets of one configuration, that are no merged ones, are parts of one data set: each shard keeps its number.
    """
    entries = [entry for some in sets.values() for entry in some]
    configs = {json.dumps(entry.meta["config"], sort_keys=True) for entry in entries}
    asked = {folder: accounting.requested_size(folder) for folder in sets}
    if len(configs) == 1 and all(asked.values()):
        first = max(sets, key=lambda folder: _episodes(asked[folder]))
        named = {entry.path.name: entry for entry in entries}
        if len(named) == len(entries):
            path = first / accounting.REQUEST_FILE
            return Plan(files.read_json(first / "config.json"), files.read_json(path) if path.exists() else None, named)
    parts = [{"config": some[0].meta["config"], "episodes": _count(some)} for some in sets.values()]
    named = {shards.shard_path(pathlib.Path(), index).name: entry for index, entry in enumerate(entries)}
    return Plan({"merged": parts, "shards": [entry.sha256 for entry in entries]}, None, named)


def _episodes(asked: accounting.RequestedSize | None) -> int:
    return asked.episodes if asked else 0


def _count(entries: Sequence[Entry]) -> int:
    return sum(int(entry.meta["episodes"]) for entry in entries)


def _say(sets: dict[pathlib.Path, list[Entry]], missing: str | None, out: str) -> None:
    """Say what has been joined, what differs, and what is missing."""
    first, *others = sets
    for folder in others:
        apart = _differences(sets[first][0].meta["config"], sets[folder][0].meta["config"])
        if apart:
            said = "; ".join(f"{key} {mine} and {its}" for key, (mine, its) in apart.items())
            console.say(f"{first} and {folder} differ: {typed.one_line(said, most=MAX_MESSAGE_CHARS)}")
    if missing:
        console.warn(missing)
    entries = [entry for some in sets.values() for entry in some]
    if mixed := accounting.describe_mixed_makers(accounting.makers([entry.meta for entry in entries])):
        console.warn(f"{out}: {mixed}")
    held = ", ".join(f"{_count(some)} from {folder}" for folder, some in sets.items())
    console.say(f"{out}: {_count(entries)} {entries[0].meta['kind']} episodes in {len(entries)} shards: {held}")


def _differences(one: Any, other: Any, at: str = "") -> dict[str, tuple[Any, Any]]:
    """Return where two configurations differ, by dotted name."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return {} if one == other else {at: (one, other)}
    found: dict[str, tuple[Any, Any]] = {}
    for key in sorted({*one, *other}):
        found |= _differences(one.get(key), other.get(key), f"{at}.{key}" if at else key)
    return found


def gather(folder: pathlib.Path) -> None:
    """List the shards that were copied into a data set, after checking that they belong there.

    Raises:
      UserError: a shard is damaged, or of another configuration than the others, or its episodes are there twice.
    """
    if not (folder / "config.json").is_file() and not (folder / manifest.MANIFEST).is_file():
        raise UserError(f"data set {folder}: no such data set; give a folder that dipn-datagen wrote")
    paths = shards.shard_files(folder)
    entries = [Entry(path, files.file_sha256(path), shards.read_meta(path)) for path in paths]
    if not entries:
        raise UserError(f"data set {folder}: no shards; copy some there, or generate them")
    _require_one({entry.path: entry.meta["kind"] for entry in entries}, "kind")
    if accounting.merged(folder) is None:
        for entry in entries[1:]:
            if apart := _differences(entries[0].meta["config"], entry.meta["config"]):
                key, (one, other) = next(iter(apart.items()))
                said = typed.one_line(f"{key} {one} and {other}", most=MAX_MESSAGE_CHARS)
                raise UserError(
                    f"merge: {entries[0].path} and {entry.path} differ in {said}; copy only shards of one data set "
                    "together, and join others by merge A B --out C"
                )
    _refuse_twice(entries)
    for entry in entries:
        shards.read_shard(entry.path, kind=entry.meta["kind"])
    listed = manifest.update_manifest(folder)
    if missing := records.missing(folder):
        console.warn(missing)
    console.say(f"{folder}: {listed['episodes']} {listed['kind']} episodes in {len(listed['shards'])} shards")
