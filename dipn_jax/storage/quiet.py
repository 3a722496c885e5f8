"""Silence what Orbax prints about a save that fails; the error that it raises says enough."""

from __future__ import annotations

import contextlib
import logging
import re
import sys
from collections.abc import Iterator
from typing import Any


def _printed(record: logging.LogRecord) -> bool:
    """Return whether a report of asyncio is printed: all are, except those of failed writes that nobody waited for."""
    return not re.match(r"\w+ exception was never retrieved", record.getMessage())  # of a Task, a Future or several


@contextlib.contextmanager
def failed_saves() -> Iterator[None]:
    """Keep Orbax from printing tracebacks of a save that fails, within a `with` statement.

    TensorStore's threads may report to Orbax's event loop after it was closed, and asyncio reports failed writes that
    nobody waited for. Both can happen some time after the failure, so they are printed again only after a save that
    succeeds.
    """
    absl, tasks, hook = logging.getLogger("absl"), logging.getLogger("asyncio"), sys.unraisablehook
    level = absl.level

    def report(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            hook(unraisable)

    tasks.addFilter(_printed)
    absl.setLevel(logging.CRITICAL)
    sys.unraisablehook = report
    try:
        yield
        sys.unraisablehook = hook
        tasks.removeFilter(_printed)
    finally:
        absl.setLevel(level)
