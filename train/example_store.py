"""Examples of a training, each made when it is first used and then kept: in memory where all fit, else in files."""

from __future__ import annotations

import pathlib
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from dipn_jax import batching
from dipn_jax.commands import console
from dipn_jax.storage.space import Space, require_room
from dipn_jax.system import files, machine

_STATE = "state.json"
"""File that says what the examples are of, and since which start of the machine they are in its memory, if they are."""


class ExampleStore:
    """Examples that are made when they are first used, and kept in memory or in files that are mapped into it.

    The operating system caches such files. A later process reuses them if the one that made them has closed them, or
    was killed: the machine's memory still has what was written. If the machine was started since, they are made again.
    """

    def __init__(self, make: Callable[[np.ndarray], Any], count: int, *, space: Space, about: str) -> None:
        """Prepare to keep `count` examples.

        Args:
          make: function of numbers `[B]`, B as `_filled` says, that returns examples `[B]`.
          count: number of examples.
          space: where to keep them; files are kept in its folder.
          about: what they are examples of: the data, and how they are made.
        """
        self._make, self._count, self._space, self._about = make, count, space, about
        self._leaves: list[np.ndarray] = []
        self._made: np.ndarray | None = None  # [count] bool
        self._structure: Any = None
        self._said: dict[str, Any] = {}  # of the examples in files

    def take(self, index: np.ndarray) -> Any:
        """Return the examples `index [B]`; those that are not there yet are made, at most `batching.BATCH` at a time.

        Raises:
          UserError: the disk has too little room for them.
        """
        index = np.asarray(index)
        if self._made is None:
            shown = np.resize(index[:1], len(_filled(np.unique(index)[: batching.BATCH])))  # a shape that is compiled
            self._open(self._make(shown))
        assert self._made is not None
        missing = np.unique(index[~self._made[index]])
        for begin in range(0, len(missing), batching.BATCH):
            self._add(missing[begin : begin + batching.BATCH])
        return jax.tree.unflatten(self._structure, [np.asarray(array[index]) for array in self._leaves])

    def _add(self, missing: np.ndarray) -> None:
        """Make examples."""
        if self._said:
            size = sum(array[:1].nbytes for array in self._leaves) * len(missing)
            require_room(self._folder, size, what="more examples")
        for array, leaf in zip(self._leaves, jax.tree.leaves(self._make(_filled(missing))), strict=True):
            array[missing] = np.asarray(leaf)[: len(missing)]
        assert self._made is not None
        self._made[missing] = True

    @property
    def _folder(self) -> pathlib.Path:
        assert self._space.folder is not None
        return self._space.folder

    def _open(self, some: Any) -> None:
        """Make room for all examples; `some [B]` show their shapes."""
        leaves, self._structure = jax.tree.flatten(jax.tree.map(np.asarray, some))
        size = self._count * sum(leaf.nbytes / len(leaf) for leaf in leaves)
        if self._space.fits(size):
            self._leaves = self._space.arrays(self._count, leaves, what="examples")
            self._made = np.zeros(self._count, bool)
        else:
            self._map([((self._count, *leaf.shape[1:]), leaf.dtype) for leaf in leaves])

    def _map(self, shapes: Sequence[tuple[tuple[int, ...], np.dtype[Any]]]) -> None:
        """Map the example files, creating them unless an earlier process's can be reused."""
        shapes = [*shapes, ((self._count,), np.dtype(bool))]
        self._said = {"about": self._about, "shapes": [[list(shape), kind.name] for shape, kind in shapes]}
        state = self._folder / _STATE
        found = files.read_json(state) if state.exists() else {}
        since = found.pop("in_memory_since", None)
        known = found == self._said and since in (None, machine.boot_id())
        if not known:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True, exist_ok=True)
        state.unlink(missing_ok=True)
        size = sum(int(np.prod(shape)) * kind.itemsize for shape, kind in shapes)
        console.say(f"{self._folder}: up to {size / 1e9:.1f} GB of examples are kept there, each made when first used")
        mapped: list[np.ndarray] = [
            np.lib.format.open_memmap(
                self._folder / f"{number}.npy", mode="r+" if known else "w+", dtype=kind, shape=shape
            )
            for number, (shape, kind) in enumerate(shapes)
        ]
        self._leaves, self._made = mapped[:-1], mapped[-1]
        if machine.boot_id():
            files.write_json(state, self._said | {"in_memory_since": machine.boot_id()})

    def close(self) -> None:
        """Write what is left of examples in files to the disk, so that another process can take them up."""
        if self._said:
            assert self._made is not None
            for array in (*self._leaves, self._made):
                array.flush()  # type: ignore[attr-defined]
            files.write_json(self._folder / _STATE, self._said)
        self._leaves, self._made, self._said = [], None, {}


def _filled(index: np.ndarray) -> np.ndarray:
    """Return up to 64 numbers repeated to 16, 32 or 64 of them, so that few shapes are compiled."""
    sizes = batching.SMALL_BATCH, batching.BATCH // 2, batching.BATCH
    return np.resize(index, next(size for size in sizes if len(index) <= size))
