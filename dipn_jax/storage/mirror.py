"""Copies of data sets from object storage in the user's cache, from which they are read."""

from __future__ import annotations

import concurrent.futures
import contextlib
import fnmatch
import hashlib
import pathlib
from collections.abc import Iterator, Mapping

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage.accounting import REQUEST_FILE
from dipn_jax.storage.manifest import MANIFEST
from dipn_jax.storage.objects import Bucket, Found
from dipn_jax.system import addresses, files, temporary, typed

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

CONFIG = "config.json"
"""Name of the file with the configuration of a data set."""
SHARDS = "shard-*.parquet"
"""Names of shards."""
INDEX = ".objects.json"
"""Name of the file that says which object each file of a copy is."""
PARALLEL_FETCHES = 8
"""Objects that are fetched at a time."""
OBJECTS_PER_INDEX_WRITE = 16
"""Objects after which the copy notes what it has, so that an interruption repeats no more."""
_FORM = {str: {"size": typed.Whole(), "tag": str}}


def local(place: pathlib.Path | str) -> pathlib.Path:
    """Return the folder of a data set: the absolute path that a user gave, or the fresh copy of what is at a URL.

    Raises:
      UserError: there is nothing at the URL, or it cannot be read.
    """
    url = addresses.url(place)
    return files.absolute(place) if url is None else _copied(url)


def fresh(url: str) -> pathlib.Path:
    """Return the folder of the copy of what is at a URL, all of which is fetched again.

    Raises:
      UserError: as `local`.
    """
    (folder_of(url) / INDEX).unlink(missing_ok=True)
    return _copied(url)


def folder_of(url: str) -> pathlib.Path:
    """Return the folder of the copy of what is at a URL.

    Raises:
      UserError: the user has no home, so no cache.
    """
    cache = files.cache()
    if cache is None:
        raise UserError(f"{url}: there is no home folder to copy it to; set XDG_CACHE_HOME to a folder")
    return cache / "data" / hashlib.sha256(url.encode()).hexdigest()[:16] / url.rpartition("/")[2]


def _copied(url: str) -> pathlib.Path:
    """Make the copy the same as what is at the URL, and return its folder."""
    bucket, folder = Bucket(url), folder_of(url)
    folder.mkdir(parents=True, exist_ok=True)
    addresses.show_instead(folder, url)
    with _file_lock(folder):
        described = {name: found for name, found in bucket.list().items() if not _is_shard(name)}
        _fetch(bucket, folder, described)
        # listed afterwards: each shard that the manifest names is there
        there = {name: found for name, found in bucket.list().items() if _is_shard(name)}
        if not there and CONFIG not in described:
            raise UserError(f"data set {url}: no such data set; give a URL that dipn-datagen wrote")
        for path in folder.glob("[!.]*"):
            if path.name not in there and path.name not in described:
                path.unlink()
        _fetch(bucket, folder, there)
    return folder


def _is_shard(name: str) -> bool:
    return fnmatch.fnmatchcase(name, SHARDS)


def _fetch(bucket: Bucket, folder: pathlib.Path, there: Mapping[str, Found]) -> None:
    """Fetch the objects of a data set that the copy lacks, or has in another version."""
    known = _known(folder)
    wanted = [name for name in there if _is_shard(name) or name in (CONFIG, REQUEST_FILE, MANIFEST)]
    todo = [name for name in wanted if not _has(folder / name, known.get(name), there[name])]
    quiet = not any(map(_is_shard, todo))
    with (
        console.Progress("download", len(wanted), unit="files", done=len(wanted) - len(todo), quiet=quiet) as progress,
        concurrent.futures.ThreadPoolExecutor(PARALLEL_FETCHES) as pool,
    ):
        for first in range(0, len(todo), OBJECTS_PER_INDEX_WRITE):
            some = todo[first : first + OBJECTS_PER_INDEX_WRITE]
            for name, got in zip(some, pool.map(bucket.get, some), strict=True):
                if got is None:  # it is being made anew
                    (folder / name).unlink(missing_ok=True)
                    continue
                files.write_atomically(folder / name, got[0])
                known[name] = got[1]
                progress.advance(1)
            files.write_json(folder / INDEX, {name: vars(found) for name, found in sorted(known.items())})


def _has(path: pathlib.Path, known: Found | None, there: Found) -> bool:
    """Return whether a file is the copy of an object as it is listed."""
    return known == there and path.is_file() and path.stat().st_size == there.size


def _known(folder: pathlib.Path) -> dict[str, Found]:
    """Return which object each file is a copy of; where that cannot be read, all are fetched again."""
    with contextlib.suppress(OSError, typed.Misfit):
        found = typed.check(typed.parse(files.read_bytes(folder / INDEX)), _FORM)
        return {name: Found(**entry) for name, entry in found.items()}
    return {}


@contextlib.contextmanager
def _file_lock(folder: pathlib.Path) -> Iterator[None]:
    """Wait until no other process updates the copy, if files can be locked."""
    with (folder / ".lock").open("wb") as lock:
        with contextlib.suppress(OSError):
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
        temporary.delete_leftovers(folder, shared=True)
        yield
