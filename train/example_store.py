"""Examples of a training, kept once they are made: in memory where they fit, else in files, made when first used."""

from __future__ import annotations

import pathlib
import shutil
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dipn_jax import batching, structs
from dipn_jax.commands import console
from dipn_jax.storage.space import Space, require_room
from dipn_jax.system import files, machine

_LARGEST = 1e6
"""Bytes that an example takes at most: tenfold those of a push of thirty objects."""
_STATE = "state.json"
"""File that says what the examples are of, and since which start of the machine they are in its memory, if they are."""


class Kept:
    """The examples of a training: all made at once and kept in memory, or, if they are large, in an `ExampleStore`."""

    def __init__(
        self,
        make: Callable[[np.ndarray], Any],
        make_all: Callable[[], Any],
        count: int,
        *,
        space: Space,
        about: str,
    ) -> None:
        """Prepare to keep examples; `ExampleStore` explains what is not explained here.

        Args:
          make: as of `ExampleStore`.
          make_all: function that returns all examples as `make` makes them, and shows how far it is.
          count: number of examples.
          space: where to keep them; files are kept in its folder.
          about: as of `ExampleStore`.
        """
        self._make, self._make_all, self._count, self._space, self._about = make, make_all, count, space, about
        self._all: Any = None
        self._store: ExampleStore | None = None

    def take(self, index: np.ndarray) -> Any:
        """Return the examples `index [B]`."""
        if self._all is None and self._store is None:
            self._begin()
        return structs.take(self._all, index) if self._store is None else self._store.take(index)

    def _begin(self) -> None:
        folder = self._space.folder
        if folder is not None and (self._space.examples_in_files or not self._space.fits(self._size())):
            self._store = ExampleStore(folder, self._make, self._count, about=self._about)
        else:
            self._all = self._make_all()

    def _size(self) -> float:
        """Return the bytes that all examples take; 0 if they fit in any case."""
        if self._space.fits(self._count * _LARGEST):
            return 0.0
        some = jax.tree.leaves(self._make(_filled(np.zeros(1, int))))
        return self._count * sum(np.asarray(leaf).nbytes / len(leaf) for leaf in some)

    def close(self) -> None:
        """See `ExampleStore.close`."""
        if self._store is not None:
            self._store.close()


class ExampleStore:
    """Examples in files that are mapped into memory; the operating system caches them.

    A later process reuses them if the one that made them has closed them, or was killed: the machine's memory still has
    what was written. If the machine was started since, they are made again.
    """

    def __init__(self, folder: pathlib.Path, make: Callable[[np.ndarray], Any], count: int, *, about: str) -> None:
        """Prepare to keep `count` examples.

        Args:
          folder: where they are kept.
          make: function of numbers `[B]`, one or several batches of `batching`, that returns examples `[B]`.
          count: number of examples.
          about: what they are examples of: the data, and how they are made.
        """
        self._folder, self._make, self._count, self._about = folder, make, count, about
        self._arrays: list[np.ndarray] | None = None
        self._structure: Any = None
        self._said: dict[str, Any] = {}

    def take(self, index: np.ndarray) -> Any:
        """Return the examples `index [B]`; those that are not there yet are made."""
        index = np.asarray(index)
        if self._arrays is None:
            self._open(self._make(_filled(index[:1])))
        arrays = self._arrays
        assert arrays is not None
        *leaves, made = arrays
        missing = np.unique(index[~made[index]])
        if len(missing):
            size = sum(array[:1].nbytes for array in leaves) * len(missing)
            require_room(self._folder, size, what="more examples")
            rows = _filled(missing)
            for array, leaf in zip(leaves, jax.tree.leaves(self._make(rows)), strict=True):
                array[missing] = np.asarray(leaf)[: len(missing)]
            made[missing] = True
        return jax.tree.unflatten(self._structure, [np.asarray(array[index]) for array in leaves])

    def _open(self, some: Any) -> None:
        """Map the example files, creating them unless an earlier process's can be reused; `some` shows shapes."""
        leaves, self._structure = jax.tree.flatten(some)
        shapes = [((self._count, *np.shape(leaf)[1:]), np.asarray(leaf).dtype) for leaf in leaves]
        shapes.append(((self._count,), np.dtype(bool)))
        about = {"about": self._about, "shapes": [[list(shape), kind.name] for shape, kind in shapes]}
        state = self._folder / _STATE
        found = files.read_json(state) if state.exists() else {}
        since = found.pop("in_memory_since", None)
        known = found == about and since in (None, machine.boot())
        if not known:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True, exist_ok=True)
        state.unlink(missing_ok=True)
        size = sum(int(np.prod(shape)) * kind.itemsize for shape, kind in shapes)
        console.say(f"{self._folder}: up to {size / 1e9:.1f} GB of examples are kept there, each made when first used")
        self._arrays = [
            np.lib.format.open_memmap(
                self._folder / f"{number}.npy", mode="r+" if known else "w+", dtype=kind, shape=shape
            )
            for number, (shape, kind) in enumerate(shapes)
        ]
        self._said = about
        if machine.boot():
            files.write_json(state, about | {"in_memory_since": machine.boot()})

    def close(self) -> None:
        """Write what is left to the disk, so that another process can take the examples up."""
        if self._arrays is not None:
            for array in self._arrays:
                array.flush()  # type: ignore[attr-defined]
            self._arrays = None
            files.write_json(self._folder / _STATE, self._said)


def _filled(index: np.ndarray) -> np.ndarray:
    """Return numbers repeated to 16, 32 or a multiple of 64 of them, so that few shapes are compiled."""
    small = next((size for size in (batching.SMALL_BATCH, batching.BATCH // 2) if len(index) <= size), batching.BATCH)
    return np.resize(index, -(-len(index) // small) * small)
