"""Checkpoints of a run that are written in the background, while training continues."""

from __future__ import annotations

import concurrent.futures
import pathlib
from types import TracebackType
from typing import Any, Self

import jax
import numpy as np

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import checkpoint, leaves


class Saver:
    """Saves the steps of a run in a thread of its own, one at a time; at the end of a `with` statement all are saved.

    A step is listed among the run's only when all of it is written, as `checkpoint.save` says.
    """

    def __init__(self, run: pathlib.Path, *, network: str, config: Any) -> None:
        """Prepare to save; arguments as of `checkpoint.save`."""
        self._run, self._network, self._config = run, network, config
        self._pool = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="save")
        self._going: concurrent.futures.Future[None] | None = None

    def save(self, step: int, parts: dict[str, Any], *, extra: Any) -> None:
        """Copy the arrays to the host, after which they may be donated, and begin to write them.

        Args:
          step: training step.
          parts: as of `checkpoint.save`.
          extra: as of `checkpoint.save`; it is not to be changed afterwards.

        Raises:
          UserError: the step before could not be saved.
        """
        self.wait()
        copied = on_host(parts)
        named = {"network": self._network, "config": self._config, "extra": extra}
        self._going = self._pool.submit(checkpoint.save, self._run, step, copied, **named)

    def wait(self) -> None:
        """Wait until the last step is saved.

        Raises:
          UserError: it could not be saved.
        """
        going, self._going = self._going, None
        if going is not None:
            going.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.wait()
        except UserError as late:
            if kind is None:
                raise
            console.warn(str(late))  # what ended the run is said after it
        finally:
            self._pool.shutdown()


def on_host(tree: Any) -> Any:
    """Return a copy of a pytree as NumPy arrays that share no memory with it; random keys become their numbers."""
    numbers = jax.tree.map(lambda leaf: jax.random.key_data(leaf) if leaves.is_key(leaf) else leaf, tree)
    return jax.tree.map(np.array, jax.device_get(numbers))
