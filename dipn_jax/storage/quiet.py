"""Silence what Orbax prints about a save that fails; the error that it raises says enough."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator
from typing import Any


def _is_of_a_waiter(record: logging.LogRecord) -> bool:
    """Return whether what asyncio reports is no write whose failure nobody has waited for."""
    return not record.getMessage().startswith("Task exception was never retrieved")


@contextlib.contextmanager
def failing() -> Iterator[None]:
    """Keep Orbax from printing tracebacks of a save that fails, within a `with` statement.

    TensorStore's threads may report to Orbax's event loop after it was closed, and asyncio names the writes that nobody
    waited for when it forgets them, both also after the failure: so only a save that succeeds lets such reports be
    printed again.
    """
    absl, tasks, hook = logging.getLogger("absl"), logging.getLogger("asyncio"), sys.unraisablehook
    level = absl.level

    def report(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            hook(unraisable)

    tasks.addFilter(_is_of_a_waiter)
    absl.setLevel(logging.CRITICAL)
    sys.unraisablehook = report
    try:
        yield
        sys.unraisablehook = hook
        tasks.removeFilter(_is_of_a_waiter)
    finally:
        absl.setLevel(level)
