"""A data set as an export reads it: shard by shard, with the numbers of episodes and scenes, and what is held out."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from dipn_jax import structs
from dipn_jax.storage import held_out, records, shards
from dipn_jax.storage.on_demand import DataSet

SPLITS = ("train", "test")
"""Names of what is learnt from and what is held out."""


@dataclasses.dataclass(frozen=True)
class Shard:
    """A shard, and what comes before it in the data set."""

    path: pathlib.Path
    count: int  # episodes
    first: int  # number of its first episode
    scene: int  # number of the scene of its first episode


@dataclasses.dataclass(frozen=True)
class Part:
    """The episodes of a shard that belong to one split; an export is written a part at a time."""

    split: str
    number: int  # among the parts of the split
    place: int  # among all parts
    shard: Shard
    rows: slice  # of the shard
    first: int  # number of its first episode among those of the split

    @property
    def name(self) -> str:
        """A name for files: parts sorted by it are in order."""
        return f"{self.split}-{self.number:05d}"

    @property
    def count(self) -> int:
        """The number of its episodes."""
        return int(self.rows.stop - self.rows.start)


@dataclasses.dataclass(frozen=True)
class Source:
    """A data set that has been checked."""

    folder: pathlib.Path
    kind: str
    slots: int  # N
    shards: tuple[Shard, ...]
    cut: int  # number of the first episode that is held out
    fingerprint: str

    @property
    def count(self) -> int:
        """The number of episodes."""
        return sum(shard.count for shard in self.shards)

    def episodes(self, split: str) -> range:
        """Return the numbers of the episodes of a split."""
        return range(0, self.cut) if split == "train" else range(self.cut, self.count)

    def parts(self) -> list[Part]:
        """Return what an export consists of, in the order of the episodes."""
        found: list[Part] = []
        for split in SPLITS:
            wanted, number = self.episodes(split), 0
            for shard in self.shards:
                begin, end = max(wanted.start, shard.first), min(wanted.stop, shard.first + shard.count)
                if begin < end:
                    rows = slice(begin - shard.first, end - shard.first)
                    found.append(Part(split, number, len(found), shard, rows, begin - wanted.start))
                    number += 1
        return found

    def read(self, part: Part) -> tuple[Any, np.ndarray, np.ndarray]:
        """Return the episodes `[B]` of a part, their numbers `[B]`, and the numbers of their scenes `[B]`."""
        episodes = shards.read_shard(part.shard.path, kind=self.kind)
        begun = np.zeros(part.shard.count, np.int64)
        begun[held_out.begins(np.asarray(episodes.scene.size))] = 1
        numbers = part.shard.first + np.arange(part.shard.count, dtype=np.int64)
        scenes = part.shard.scene + np.cumsum(begun) - 1
        return structs.take(episodes, part.rows), numbers[part.rows], scenes[part.rows]


def open_source(folder: pathlib.Path) -> Source:
    """Check a data set, and find where its scenes begin and what of it training holds out.

    Raises:
      UserError: there is none, it is damaged, or it cannot be split.
    """
    kind = str(records.summary(folder)["kind"])
    opened = records.opened(folder, kind=kind)
    found = _surveyed(opened)
    cut = held_out.cut(lambda rows: opened.column("scene.size", range(rows.start, rows.stop)), len(opened), folder)
    return Source(folder, kind, opened.slots, found, cut, opened.fingerprint)


def _surveyed(opened: DataSet) -> tuple[Shard, ...]:
    """Return the shards of a data set in order, with their first episodes and scenes."""
    found: list[Shard] = []
    first = begun = 0
    before: np.ndarray | None = None
    for shard in opened.shards:
        size = shards.read_column(shard.path, "scene.size")
        rows = held_out.begins(size, before=before)
        goes_on = len(rows) == 0 or rows[0] != 0
        found.append(Shard(shard.path, len(size), first, begun - 1 if goes_on else begun))
        first, begun, before = first + len(size), begun + len(rows), size[-1]
    return tuple(found)


def blocks(count: int, size: int) -> Iterator[slice]:
    """Return the slices of `count` rows, `size` at a time."""
    for begin in range(0, count, size):
        yield slice(begin, min(begin + size, count))
