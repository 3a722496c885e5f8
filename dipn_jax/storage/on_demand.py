"""Episodes of data sets, whose shards are read when one of their episodes is first taken."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import pathlib
import threading
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.storage import codec, shards
from dipn_jax.storage.space import Space, put
from dipn_jax.structs import ABSENT, Array
from dipn_jax.system import machine
from dipn_jax.world import scenes

PROGRESS_SHARDS = 100
"""Number of shards from which on progress is shown while all of them are read."""
Rows = range | Int[np.ndarray, " _"]
"""Numbers of episodes of a data set, in ascending order; a range has no gaps."""


@dataclasses.dataclass(frozen=True)
class Shard:
    """One shard of a data set."""

    path: pathlib.Path
    sha256: str
    meta: dict[str, Any]  # of its metadata `columns` and `episodes`

    @property
    def count(self) -> int:
        """The number of its episodes."""
        return int(self.meta["episodes"])


@dataclasses.dataclass(frozen=True)
class DataSet:
    """A data set whose shards have been checked, and of whose episodes none has been read."""

    kind: str  # key of `layout.KINDS`
    shards: tuple[Shard, ...]
    like: Any  # a struct of no episodes [0, ...] that shows the shapes and types of their arrays
    fingerprint: str

    def __len__(self) -> int:
        return sum(shard.count for shard in self.shards)

    @property
    def slots(self) -> int:
        """The number of object slots."""
        return int(self.like.scene.shape.shape[1])

    def column(self, name: str, rows: Rows | None = None) -> np.ndarray:
        """Return one leaf of episodes `[B, ...]`, and read no other: from those shards only that hold some of them.

        Args:
          name: as `codec.columns` names it, such as `scene.size`; not `after`, which is stored as a difference.
          rows: which episodes; None: all.

        Raises:
          UserError: see `shards.read_meta`.
        """
        pieces = _pieces(self, range(len(self)) if rows is None else rows)
        if not pieces:
            return codec.columns(self.like)[name]
        with concurrent.futures.ThreadPoolExecutor(machine.cores()) as pool:
            found = pool.map(lambda of: shards.read_column(of.shard.path, name, meta=of.shard.meta)[of.rows], pieces)
            return np.concatenate(list(found))


@dataclasses.dataclass(frozen=True)
class _Piece:
    """Episodes that come from one shard."""

    of: DataSet
    shard: Shard
    rows: slice | np.ndarray  # of the shard
    begin: int  # where they stand among all
    end: int

    @property
    def complete(self) -> bool:
        """Whether it is all of the shard."""
        return self.end - self.begin == self.shard.count


def _pieces(of: DataSet, rows: Rows, *, first: int = 0) -> list[_Piece]:
    """Return the pieces of a data set that hold these episodes; those before them end at `first`."""
    bounds = np.cumsum([0, *(shard.count for shard in of.shards)])
    if isinstance(rows, range):
        at = np.clip(bounds, rows.start, max(rows.start, rows.stop)) - rows.start
    else:
        at = np.searchsorted(rows, bounds)
    found = []
    for number in np.flatnonzero(at[1:] > at[:-1]):
        begin, end, skipped = int(at[number]), int(at[number + 1]), int(bounds[number])
        some = rows[begin:end]
        within = slice(some.start - skipped, some.stop - skipped) if isinstance(some, range) else some - skipped
        found.append(_Piece(of, of.shards[number], within, first + begin, first + end))
    return found


class Episodes:
    """Chosen episodes of data sets, one data set after another, all with as many slots as any of these has.

    There is room for all of them from the start. A shard is read when one of its episodes is first taken; any thread
    may take some. The shards have to stay as they are meanwhile.
    """

    def __init__(self, chosen: Sequence[tuple[DataSet, Rows]], space: Space) -> None:
        """Make room for episodes.

        Args:
          chosen: data sets of one kind, each with the numbers of those of its episodes that are wanted.
          space: where to put them.

        Raises:
          UserError: the disk has too little room.
        """
        self._pieces: list[_Piece] = []
        for of, rows in chosen:
            self._pieces += _pieces(of, rows, first=self._pieces[-1].end if self._pieces else 0)
        self._ends = np.array([piece.end for piece in self._pieces], np.int64)
        self._read = np.zeros(len(self._pieces), bool)
        self._lock = threading.Lock()
        self.slots = max(of.slots for of, _ in chosen)
        self._whole = space.arrays(len(self), widened(chosen[0][0].like, self.slots), what="episodes")

    def __len__(self) -> int:
        return self._pieces[-1].end if self._pieces else 0

    def take(self, index: np.ndarray | slice) -> Any:
        """Return the episodes `index`, a struct of NumPy arrays with a leading `[B]`; shards that it needs are read.

        Raises:
          UserError: a shard cannot be read, or was changed since it was checked.
          IndexError: there is no such episode.
        """
        rows = np.arange(len(self))[index] if isinstance(index, slice) else np.asarray(index)
        if rows.size and not 0 <= rows.min() <= rows.max() < len(self):
            raise IndexError(f"episodes {rows.min()} to {rows.max()} of {len(self)}")
        self._require(np.searchsorted(self._ends, rows, side="right"))
        return structs.take(self._whole, index)

    def whole(self) -> Any:
        """Return all episodes, as `take` does; progress is shown where they are in many shards."""
        count = len(self._pieces)
        title = f"read {self._pieces[0].of.kind}" if count else "read"
        with console.Progress(title, count, unit="shards", quiet=count < PROGRESS_SHARDS) as progress:
            self._require(np.arange(count), progress)
        return self._whole

    def _require(self, numbers: np.ndarray, progress: console.Progress | None = None) -> None:
        """Read those of the pieces with these numbers that have not been read yet, on all cores."""
        if self._read[numbers].all():
            return
        with self._lock:
            missing = np.unique(numbers[~self._read[numbers]])  # another thread may have read some meanwhile
            with concurrent.futures.ThreadPoolExecutor(machine.cores()) as pool:
                for _ in pool.map(self._fill, missing):
                    if progress is not None:
                        progress.advance(1)

    def _fill(self, number: int) -> None:
        """Read a piece."""
        piece = self._pieces[number]
        place = structs.take(self._whole, slice(piece.begin, piece.end))
        read = {"kind": piece.of.kind, "sha256": piece.shard.sha256}
        if piece.complete and piece.of.slots == self.slots:
            shards.read_shard(piece.shard.path, into=place, **read)
        else:
            some = structs.take(shards.read_shard(piece.shard.path, **read), piece.rows)
            put(place, 0, widened(some, self.slots))
        self._read[number] = True


def widened(episodes: Any, slots: int) -> Any:
    """Return episodes `[B, N]` as `[B, slots]`, so that data sets of different numbers of objects can be joined."""
    more = slots - episodes.scene.shape.shape[1]
    if not more:
        return episodes

    def pad(leaf: Array, value: float = 0) -> np.ndarray:
        edges = [(0, 0), (0, more)] + [(0, 0)] * (leaf.ndim - 2)
        return np.pad(leaf, edges, constant_values=value)

    def park(poses: Array) -> np.ndarray:
        away = np.broadcast_to(scenes.parked(more), (*poses.shape[:-2], more, 7))
        return np.concatenate([poses, away], -2)

    changes = {name: park(getattr(episodes, name)) for name in ("poses", "after") if hasattr(episodes, name)}
    changes |= {"held": pad(episodes.held)} if hasattr(episodes, "held") else {}
    scene = jax.tree.map(pad, episodes.scene).replace(shape=pad(episodes.scene.shape, ABSENT))
    return episodes.replace(scene=scene, **changes)
