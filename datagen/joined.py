"""Where joined shards are copied to: a folder, or object storage, in which nothing is locked or renamed."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import fnmatch
import functools
import hashlib
import json
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Collection, Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, manifest, mirror, owner, shards
from dipn_jax.storage.accounting import REQUEST_FILE
from dipn_jax.storage.manifest import MANIFEST
from dipn_jax.storage.mirror import CONFIG
from dipn_jax.storage.objects import Bucket
from dipn_jax.system import addresses, files


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


@dataclasses.dataclass(frozen=True)
class Plan:
    """A joined data set."""

    config: dict[str, Any]
    request: dict[str, Any] | None  # the command that makes it, as `accounting.save_command` keeps it
    entries: dict[str, Entry]  # its shards by their names in it

    def describe(self, folder: pathlib.Path) -> None:
        """Write the configuration and the command to a folder."""
        files.write_json(folder / CONFIG, self.config)
        if self.request is not None:
            files.write_json(folder / REQUEST_FILE, self.request)

    def missing(self, folder: pathlib.Path) -> str | None:
        """Say what is missing of it, as `accounting.missing`; `describe` has written to the folder."""
        held = {name: {"episodes": entry.meta["episodes"]} for name, entry in self.entries.items()}
        return accounting.missing(folder, accounting.episodes_by_shard(held))

    def holds_another(self, folder: pathlib.Path, names: Collection[str]) -> bool:
        """Return whether a place holds something else than a part of this data set.

        Args:
          folder: with the configuration that is there, if there is one.
          names: of the shards that are there.

        Raises:
          UserError: the configuration is damaged.
        """
        if not (folder / CONFIG).exists():
            return bool(names)
        return files.read_json(folder / CONFIG) != self.config or not set(names) <= self.entries.keys()


def into_folder(plan: Plan, out: pathlib.Path) -> str | None:
    """Copy the shards that are not in a folder yet, list all, and say what is missing, as `Plan.missing`.

    Raises:
      UserError: the folder holds something else, or is in use.
    """
    with owner.owned(out):
        if plan.holds_another(out, {path.name for path in shards.shard_files(out)}):
            raise UserError(f"--out {out}: holds another data set; give another folder")
        plan.describe(out)
        entries = plan.entries
        there = [
            name for name in entries if (out / name).is_file() and files.file_sha256(out / name) == entries[name].sha256
        ]
        with console.Progress("merge", len(entries), unit="shards", done=len(there)) as progress:
            for name in entries.keys() - set(there):
                with files.replacing(out / name) as path:
                    shutil.copyfile(entries[name].path, path)
                progress.advance(1)
        manifest.update_manifest(out)
        return plan.missing(out)


def into_bucket(plan: Plan, url: str) -> str | None:
    """Create the shards that are not at a URL yet, list all, and say what is missing, as `Plan.missing`.

    A shard that is there, or that somebody else creates meanwhile, has to be the same; none is replaced.

    Raises:
      UserError: there is something else at the URL, or it cannot be written to.
    """
    with tempfile.TemporaryDirectory(prefix="dipn-datagen-") as name:
        folder, bucket = pathlib.Path(name), Bucket(url, make=True)
        addresses.show_instead(folder, url)
        _refuse(plan, bucket, folder)
        found = {name: one for name, one in bucket.list().items() if name in plan.entries}
        listed = manifest.listed(folder) if _fetched(bucket, folder, MANIFEST) else {}
        same = {name for name, one in found.items() if _known(plan.entries[name], one.size, listed.get(name))}
        _each(functools.partial(_compare, plan, bucket), sorted(found.keys() - same), title="look")
        plan.describe(folder)
        if not bucket.create(CONFIG, files.read_bytes(folder / CONFIG)):  # perhaps by another one, at this moment
            _refuse(plan, bucket, folder)
        if plan.request is not None:
            bucket.put(REQUEST_FILE, files.read_bytes(folder / REQUEST_FILE))
        todo = sorted(plan.entries.keys() - found.keys())
        _each(functools.partial(_create, plan, bucket), todo, title="merge", done=len(found))
        manifest.write(folder, {name: shards.entry(entry.path) for name, entry in sorted(plan.entries.items())})
        bucket.put(MANIFEST, files.read_bytes(folder / MANIFEST))
        return plan.missing(folder)


def _refuse(plan: Plan, bucket: Bucket, folder: pathlib.Path) -> None:
    """Raise a UserError if something else is in the bucket; the configuration that is there is then in the folder."""
    _fetched(bucket, folder, CONFIG)
    if plan.holds_another(folder, fnmatch.filter(bucket.list(), mirror.SHARDS)):
        raise UserError(f"--out {bucket.url}: holds another data set; give another URL")


def _fetched(bucket: Bucket, folder: pathlib.Path, name: str) -> bool:
    """Put an object into a folder, and return whether there is one."""
    got = bucket.get(name)
    if got is not None:
        files.write_atomically(folder / name, got[0])
    return got is not None


def _known(entry: Entry, size: int, listed: dict[str, Any] | None) -> bool:
    """Return whether the manifest beside a shard says that it is this one."""
    return listed is not None and (listed["sha256"], listed["bytes"]) == (entry.sha256, size)


def _each(function: Callable[[str], None], names: Sequence[str], *, title: str, done: int = 0) -> None:
    """Call a function with names of shards, several at a time."""
    quiet = title == "look" and len(names) < manifest.SILENT_SHARDS
    with (
        console.Progress(title, len(names) + done, unit="shards", done=done, quiet=quiet) as progress,
        concurrent.futures.ThreadPoolExecutor(mirror.PARALLEL_FETCHES) as pool,
    ):
        for _ in pool.map(function, names):
            progress.advance(1)


def _compare(plan: Plan, bucket: Bucket, name: str) -> None:
    """Raise a UserError if a shard in the bucket is not the one that belongs there."""
    got = bucket.get(name)
    if got is None or hashlib.sha256(got[0]).hexdigest() != plan.entries[name].sha256:
        raise UserError(
            f"--out {bucket.url}: its {name} is not {plan.entries[name].path}; give another URL, or, if it is damaged, "
            f"run dipn-datagen repair {bucket.url} before"
        )


def _create(plan: Plan, bucket: Bucket, name: str) -> None:
    """Create a shard in the bucket, unless the same one is there by now."""
    if not bucket.create(name, files.read_bytes(plan.entries[name].path)):
        _compare(plan, bucket, name)
