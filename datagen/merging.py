"""Data sets joined to one: their shards, byte for byte, in one folder."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import shutil
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, manifest, owner, records, shards
from dipn_jax.system import files, typed

MAX_MESSAGE_CHARS = 400
"""Characters of what differs between two data sets that are shown at most."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A shard that is to be joined with others."""

    path: pathlib.Path
    sha256: str
    meta: dict[str, Any]

    @property
    def scenes(self) -> str:
        """What its scenes were drawn from; empty where that is not recorded."""
        config = self.meta["config"]
        if "seed" not in config:
            return ""
        return json.dumps([self.meta["kind"], config["seed"], config.get("scene"), self.meta["shard"]], sort_keys=True)


def merge(folders: Sequence[pathlib.Path], out: pathlib.Path) -> None:
    """Join data sets in the folder `out`.

    Raises:
      UserError: one is missing or damaged, they are of several kinds or numbers of slots or have too many shards,
        episodes were made twice, or the folder holds something else.
    """
    if out in folders or len(set(folders)) < len(folders):
        raise UserError(f"merge: {out if out in folders else folders[0]} is named twice; want each folder once")
    sets = {folder: _entries(folder) for folder in folders}
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
    identity, first, names = _plan(sets)
    with owner.owned(out):
        config = out / "config.json"
        others = {path.name for path in shards.shard_files(out)} - set(names)
        if others or (config.exists() and files.read_json(config) != identity):
            raise UserError(f"--out {out}: holds another data set; give another folder")
        files.write_json(config, identity)
        if first is not None and (first / accounting.REQUEST_FILE).exists():
            files.write_json(out / accounting.REQUEST_FILE, files.read_json(first / accounting.REQUEST_FILE))
        _copy(dict(zip(names, entries, strict=True)), out)
    _say(sets, out)


def _entries(folder: pathlib.Path) -> list[Entry]:
    """Return the shards of a data set, each of which is whole."""
    found = records.whole(folder, kind=str(records.summary(folder)["kind"]))
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


def _plan(sets: dict[pathlib.Path, list[Entry]]) -> tuple[dict[str, Any], pathlib.Path | None, list[str]]:
    """Return the configuration of the result, the data set whose command makes it, and the names of its shards.

    Data sets of one configuration, that are no merged ones, are parts of one data set: each shard keeps its number.
    """
    configs = {json.dumps(entry.meta["config"], sort_keys=True) for some in sets.values() for entry in some}
    asked = {folder: accounting.asked(folder) for folder in sets}
    if len(configs) == 1 and all(asked.values()):
        first = max(sets, key=lambda folder: _episodes(asked[folder]))
        names = [entry.path.name for some in sets.values() for entry in some]
        if len(set(names)) == len(names):
            return files.read_json(first / "config.json"), first, names
    parts = [{"config": some[0].meta["config"], "episodes": _count(some)} for some in sets.values()]
    number = sum(map(len, sets.values()))
    names = [shards.shard_path(pathlib.Path(), index).name for index in range(number)]
    shas = [entry.sha256 for some in sets.values() for entry in some]
    return {"merged": parts, "shards": shas}, None, names


def _episodes(asked: accounting.Asked | None) -> int:
    return asked.episodes if asked else 0


def _count(entries: Sequence[Entry]) -> int:
    return sum(int(entry.meta["episodes"]) for entry in entries)


def _copy(entries: dict[str, Entry], out: pathlib.Path) -> None:
    """Copy the shards that are not there yet, and list all."""
    there = [
        name for name in entries if (out / name).is_file() and files.file_sha256(out / name) == entries[name].sha256
    ]
    with console.Progress("merge", len(entries), unit="shards", done=len(there)) as progress:
        for name in entries.keys() - set(there):
            with files.replacing(out / name) as path:
                shutil.copyfile(entries[name].path, path)
            progress.advance(1)
    manifest.update_manifest(out)


def _say(sets: dict[pathlib.Path, list[Entry]], out: pathlib.Path) -> None:
    """Say what has been joined, what differs, and what is missing."""
    first, *others = sets
    for folder in others:
        apart = _differences(sets[first][0].meta["config"], sets[folder][0].meta["config"])
        if apart:
            said = "; ".join(f"{key} {mine} and {its}" for key, (mine, its) in apart.items())
            console.say(f"{first} and {folder} differ: {typed.one_line(said, most=MAX_MESSAGE_CHARS)}")
    about = records.summary(out)
    if about["missing"]:
        console.warn(about["missing"])
    if mixed := accounting.mixed(about["made_by"]):
        console.warn(f"{out}: {mixed}")
    held = ", ".join(f"{_count(some)} from {folder}" for folder, some in sets.items())
    console.say(f"{out}: {about['episodes']} {about['kind']} episodes in {about['shards']} shards: {held}")


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
