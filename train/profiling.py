"""A profile of some steps of a training."""

from __future__ import annotations

import pathlib
from types import TracebackType
from typing import Self

import jax

FIRST_STEP = 5
"""Step of this process at which a profile begins; earlier steps compile programs."""
LAST_STEP = 15
"""Step of this process at which the profile ends."""


class Profiler:
    """A context in which steps FIRST_STEP to LAST_STEP are traced by JAX's profiler, if a folder is given."""

    def __init__(self, folder: pathlib.Path | None, begin: int) -> None:
        """Prepare to profile a run that begins with step `begin`, into `folder`."""
        self._folder, self._begin, self._going = folder, begin, False

    def see(self, step: int) -> None:
        """Begin or end the profile, where this step is the first or the last of it."""
        if self._folder is None:
            return
        if step == self._begin + FIRST_STEP:
            jax.profiler.start_trace(self._folder)
            self._going = True
        elif step == self._begin + LAST_STEP:
            self._stop()

    def _stop(self) -> None:
        if self._going:
            self._going = False
            jax.profiler.stop_trace()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
