"""Space for the large arrays of a job: memory as far as it is granted, and files that are mapped into it beyond."""

from __future__ import annotations

import math
import os
import pathlib
import shutil
import tempfile
import weakref
from typing import Any

import jax
import numpy as np

from dipn_jax.commands import console
from dipn_jax.errors import UserError

FREE_DISK_BYTES = 100e6
"""Bytes that are left free on a disk."""


class Space:
    """Memory and a disk for arrays; what is granted is shared by all that is put there."""

    def __init__(self, memory: float = math.inf, folder: pathlib.Path | None = None) -> None:
        """Grant memory.

        Args:
          memory: GB that all arrays may take in memory.
          folder: what does not fit is put in files on the disk of this folder, which need not exist; None: everything
            is put in memory.
        """
        self.folder = folder
        self._memory = 1e9 * memory
        self._taken = 0

    def fits(self, size: float) -> bool:
        """Return whether `size` bytes more may be put in memory."""
        return self.folder is None or self._taken + size <= self._memory

    def arrays(self, count: int, like: Any, *, what: str) -> Any:
        """Return uninitialized arrays `[count, ...]`; files are deleted when their arrays are not used any more.

        Args:
          count: length of their first axis.
          like: a pytree of arrays `[B, ...]` of the same shapes, but for the first axis, and types.
          what: what they will hold, for the line that says that files are used.

        Raises:
          UserError: the disk has too little room.
        """
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((count, *leaf.shape[1:]), leaf.dtype), like)
        size = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
        if self.fits(size):
            return jax.tree.map(self._in_memory, shapes)
        assert self.folder is not None
        disk = next(place for place in (self.folder, *self.folder.parents) if place.is_dir())
        require_room(disk, size, what=what)
        console.say(f"{disk}: {_shown(size)} of {what} are kept in temporary files there")
        return jax.tree.map(lambda leaf: _in_a_file(disk, leaf), shapes)

    def _in_memory(self, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        made: np.ndarray = np.empty(leaf.shape, leaf.dtype)
        self._taken += made.nbytes
        weakref.finalize(made, self._give_back, made.nbytes)
        return made

    def _give_back(self, size: int) -> None:
        self._taken -= size


def put(whole: Any, begin: int, part: Any) -> None:
    """Put rows `part [B, ...]` into arrays `whole [N, ...]` from row `begin` on."""
    for array, leaf in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
        array[begin : begin + len(leaf)] = leaf


def require_room(folder: pathlib.Path, size: float, *, what: str) -> None:
    """Check that the disk of a folder has room for `size` bytes; writing to a mapped file would end the process there.

    Raises:
      UserError: it has not; `what` says what for.
    """
    free = shutil.disk_usage(folder).free
    if free < size + FREE_DISK_BYTES:
        raise UserError(
            f"{folder}: {_shown(free)} are free, and {what} need {_shown(size)} and some to spare; make room and give "
            "the same command again, or give a larger --memory"
        )


def _shown(size: float) -> str:
    """Return a number of bytes as people read it."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _in_a_file(folder: pathlib.Path, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
    """Return an array in a file without a name on the disk of a folder; nothing is left of it when a process ends."""
    size = math.prod(leaf.shape) * leaf.dtype.itemsize
    if not size:
        return np.empty(leaf.shape, leaf.dtype)
    with tempfile.TemporaryFile(dir=folder) as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)  # a disk that is full says so here
        return np.memmap(file, leaf.dtype, "r+" if hasattr(os, "posix_fallocate") else "w+", shape=leaf.shape)
