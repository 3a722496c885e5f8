"""Batches of a training, made by another thread while a step is computed."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable
from typing import Any, Self


class Prefetcher:
    """Prepares the batch of the next step in a thread; a context manager that starts and ends the thread.

    There is one thread, so that batches are made one after another, and an error is raised at the step of its batch.
    At the end it is waited for; Grain, which can do the rest, does not wait, and examples in files are closed then.
    """

    def __init__(self, make: Callable[[int], Any], begin: int, end: int) -> None:
        """Prepare to make batches.

        Args:
          make: function of the number of a step that returns its batch.
          begin: the first step.
          end: the number after that of the last step.
        """
        self._make, self._step, self._end = make, begin, end
        self._pool = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="batches")
        self._next: concurrent.futures.Future[Any] | None = None

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def take(self) -> Any:
        """Return the batch of the next step, and let the thread make the one after it."""
        assert self._next is not None, "there are no more steps"
        batch = self._next.result()
        self._step += 1
        self._start()
        return batch

    def _start(self) -> None:
        self._next = self._pool.submit(self._make, self._step) if self._step < self._end else None
