"""Where a data set is written: a folder, or object storage.

Shards are written to a folder in either case. For object storage that folder is a temporary one of this process; each
shard is then created in the bucket, which succeeds for one writer only, and nothing is locked or renamed.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import fnmatch
import pathlib
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from dipn_jax.commands import console
from dipn_jax.storage import accounting, manifest, mirror, records, shards
from dipn_jax.storage.manifest import MANIFEST
from dipn_jax.storage.objects import Bucket
from dipn_jax.system import addresses, files, temporary

MAX_HEAD_REQUESTS = 8
"""Number of shards up to which each is asked for by its name; for more of them, the whole bucket is listed."""
Claim = Callable[[pathlib.Path], None]
"""Writes the configuration of a data set to its folder, or raises UserError if another one is there."""


class Place(Protocol):
    """Where a data set is written."""

    name: str  # for the user
    folder: pathlib.Path  # in which shards are written

    def begun(self) -> bool:
        """Return whether the data set has a configuration."""

    def claim(self, claim: Claim) -> None:
        """Let `claim` write the configuration, or compare it with the one that is there."""

    def note(self, command: Sequence[str], *, of: int) -> None:
        """Keep the command, as `accounting.save_command`."""

    def counts(self, indices: Sequence[int]) -> dict[int, int]:
        """Return the number of episodes in each of these shards that is there."""

    def entry(self, index: int) -> dict[str, Any]:
        """Return the entry in the manifest of a shard that `counts` has found."""

    def forget(self, indices: Collection[int]) -> None:
        """Take shards out of the manifest that are about to be made."""

    def commit(self, index: int, entry: dict[str, Any]) -> dict[str, Any]:
        """Add a written shard and return its manifest entry, or that of another worker who was first."""

    def names(self) -> set[str]:
        """Return the names of the shards that are there."""

    def list(self, made: Mapping[str, Any]) -> dict[str, Any]:
        """Write the manifest, with the entries of the shards that were made by their names, and return it."""

    def list_whole(self, made: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, Any] | None:
        """Do as `list` if all shards of these names are there, each with as many episodes; else return None."""


class Folder:
    """A folder on a disk."""

    def __init__(self, folder: pathlib.Path) -> None:
        console.require_out(folder)
        self.name, self.folder = str(folder), folder

    def begun(self) -> bool:
        return (self.folder / mirror.CONFIG).exists()

    def claim(self, claim: Claim) -> None:
        claim(self.folder)
        temporary.delete_leftovers(self.folder, shared=True)

    def note(self, command: Sequence[str], *, of: int) -> None:
        accounting.save_command(self.folder, command, of=of)

    def counts(self, indices: Sequence[int]) -> dict[int, int]:
        paths = {index: shards.shard_path(self.folder, index) for index in indices}
        return {index: shards.count(path) for index, path in paths.items() if path.exists()}

    def entry(self, index: int) -> dict[str, Any]:
        return shards.entry(shards.shard_path(self.folder, index))

    def forget(self, indices: Collection[int]) -> None:
        manifest.forget(self.folder, {_name(index) for index in indices})

    def commit(self, index: int, entry: dict[str, Any]) -> dict[str, Any]:
        return entry

    def list(self, made: Mapping[str, Any]) -> dict[str, Any]:
        return manifest.update_manifest(self.folder, made=made)

    def names(self) -> set[str]:
        return {path.name for path in shards.shard_files(self.folder)}

    def list_whole(self, made: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, Any] | None:
        return manifest.update_whole(self.folder, made=made, sizes=sizes)


class Objects:
    """A data set in object storage, and a temporary folder."""

    def __init__(self, url: str, folder: pathlib.Path, *, look: bool) -> None:
        self.name, self.folder = url, folder
        self._bucket = Bucket(url, make=True, look=look)
        self._entries: dict[str, Any] = {}  # of shards that are there, by name

    def begun(self) -> bool:
        return self._bucket.get(mirror.CONFIG) is not None

    def claim(self, claim: Claim) -> None:
        """See `Place.claim`. If two begin at the same time, the second compares its configuration with the first."""
        path = self.folder / mirror.CONFIG
        while True:
            there = self._fetched(mirror.CONFIG)
            claim(self.folder)
            mine = files.read_bytes(path)
            if there:
                if mine != there:  # more episodes are asked for
                    self._bucket.put(mirror.CONFIG, mine)
                return
            if self._bucket.create(mirror.CONFIG, mine):
                return

    def note(self, command: Sequence[str], *, of: int) -> None:
        accounting.save_command(self.folder, command, of=of)
        self._bucket.put(accounting.REQUEST_FILE, files.read_bytes(self.folder / accounting.REQUEST_FILE))

    def counts(self, indices: Sequence[int]) -> dict[int, int]:
        """As `Place.counts`: shards that the manifest does not list are fetched to be looked at.

        A few cost a request each, however many there are in the bucket.
        """
        asked = {index: _name(index) for index in indices}
        if len(asked) > MAX_HEAD_REQUESTS:
            there = self._bucket.list()
        else:
            there = {name: found for name in asked.values() if (found := self._bucket.head(name))}
        names = {index: name for index, name in asked.items() if name in there}
        known = (self._listed() if names else {}) | self._entries
        listed = [name for name in names.values() if name in known and known[name]["bytes"] == there[name].size]
        self._entries = {name: known[name] for name in listed}
        self._entries |= self._look(name for name in names.values() if name not in self._entries)
        return {index: self._entries[name]["episodes"] for index, name in names.items() if name in self._entries}

    def entry(self, index: int) -> dict[str, Any]:
        return dict(self._entries[_name(index)])

    def forget(self, indices: Collection[int]) -> None:
        """As `Place.forget`; only a shorter shard, of fewer episodes, can be listed."""
        names = {_name(index) for index in indices} & self._entries.keys()
        for name in names:
            del self._entries[name]
        listed = self._listed() if names else {}
        if names & listed.keys():
            self._write({name: entry for name, entry in listed.items() if name not in names})

    def commit(self, index: int, entry: dict[str, Any]) -> dict[str, Any]:
        """See `Place.commit`; a shard that another writer made first stays, unless its length differs."""
        name = _name(index)
        data = files.read_bytes(self.folder / name)
        try:
            while not self._bucket.create(name, data):
                theirs = self._looked_at(name)
                if theirs and theirs["episodes"] == entry["episodes"]:
                    return theirs
                self._bucket.delete(name)
            return entry
        finally:
            (self.folder / name).unlink(missing_ok=True)

    def list(self, made: Mapping[str, Any]) -> dict[str, Any]:
        return self._write(self._held(made))

    def names(self) -> set[str]:
        return {name for name in self._bucket.list() if fnmatch.fnmatchcase(name, mirror.SHARDS)}

    def list_whole(self, made: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, Any] | None:
        """See `Place.list_whole`; shards of others are fetched to be looked at."""
        held = self._held(made)
        held |= self._look(name for name in sizes if name not in held)
        return self._write(dict(sorted(held.items()))) if manifest.holds(held, sizes) else None

    def _held(self, made: Mapping[str, Any]) -> dict[str, Any]:
        """Return the entries that are known of shards that are there, or that were made here."""
        known, there = self._listed() | self._entries | dict(made), self._bucket.list()
        sizes = {name: entry["bytes"] for name, entry in made.items()}  # the bucket may list them late
        sizes |= {name: found.size for name, found in there.items()}
        return {name: known[name] for name in sorted(sizes) if name in known and known[name]["bytes"] == sizes[name]}

    def _look(self, names: Iterable[str]) -> dict[str, Any]:
        """Fetch these shards, and return the entries of those that are there, by name."""
        todo = [*names]
        found: dict[str, Any] = {}
        with (
            console.Progress("look", len(todo), unit="shards", quiet=len(todo) < manifest.SILENT_SHARDS) as progress,
            concurrent.futures.ThreadPoolExecutor(mirror.PARALLEL_FETCHES) as pool,
        ):
            for name, entry in zip(todo, pool.map(self._looked_at, todo), strict=True):
                found |= {name: entry} if entry else {}
                progress.advance(1)
        return found

    def _fetched(self, name: str) -> bytes:
        """Return the content of an object, which is then in the folder; nothing where there is none."""
        got = self._bucket.get(name)
        if got is None:
            (self.folder / name).unlink(missing_ok=True)
            return b""
        files.write_atomically(self.folder / name, got[0])
        return got[0]

    def _looked_at(self, name: str) -> dict[str, Any] | None:
        """Return the entry of a shard that is there; None where it is not."""
        got = self._bucket.get(name)
        if got is None:
            return None
        path = self.folder / name
        try:
            path.write_bytes(got[0])
            return shards.entry(path)
        finally:
            path.unlink(missing_ok=True)

    def _listed(self) -> dict[str, Any]:
        return manifest.listed(self.folder) if self._fetched(MANIFEST) else {}

    def _write(self, entries: dict[str, Any]) -> dict[str, Any]:
        found = manifest.write(self.folder, entries)
        self._bucket.put(MANIFEST, files.read_bytes(self.folder / MANIFEST))
        return found


def end(place: Place, made: Mapping[str, Any], *, sizes: Mapping[int, int], alone: bool) -> str:
    """End a worker that has made its shards, and return the line that says what is there.

    The only worker writes the manifest; one of several if the shards of all are there, so two may write the same.

    Args:
      place: the data set.
      made: entries of the shards that this worker made, by name.
      sizes: number of episodes of every shard of the data set.
      alone: whether it is the only worker.
    """
    named = {_name(index): size for index, size in sizes.items()}
    there = named.keys() if alone else (place.names() | made.keys()) & named.keys()
    listed = None
    if len(there) == len(named):
        listed = place.list(made) if alone else place.list_whole(made, named)
    if listed is None:
        return f"{place.name}: {len(there)} of {len(named)} shards are there; the worker that ends last lists them"
    return f"{place.name}: {listed['episodes']} {listed['kind']} episodes in {len(listed['shards'])} shards"


def _name(index: int) -> str:
    return shards.shard_path(pathlib.Path(), index).name


@contextlib.contextmanager
def opened(out: pathlib.Path, *, look: bool = True) -> Iterator[Place]:
    """Return a context whose value is where a data set is written: the folder `out`, or what is at the URL.

    Args:
      out: the folder, or the URL.
      look: whether to look first if a bucket can be listed, as `Bucket` does; a task's driver has done that.

    Raises:
      UserError: it cannot be written to.
    """
    url = addresses.url(out)
    if url is None:
        yield Folder(out)
        return
    with tempfile.TemporaryDirectory(prefix="dipn-datagen-") as folder:
        addresses.show_instead(pathlib.Path(folder), url)
        yield Objects(url, pathlib.Path(folder), look=look)


def repair(url: str) -> list[pathlib.Path]:
    """Rename damaged shards at a URL to `*.damaged`, rebuild the manifest, and return the former paths in the copy.

    Raises:
      UserError: as `records.repair`, or as `mirror.local`.
    """
    bucket, copy = Bucket(url), mirror.fresh(url)
    removed = records.repair(copy)
    for path in removed:
        got = bucket.get(path.name)
        if got is not None:
            bucket.put(f"{path.name}.damaged", got[0])
            bucket.delete(path.name)
    bucket.put(MANIFEST, files.read_bytes(copy / MANIFEST))
    return removed
