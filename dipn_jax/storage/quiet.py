"""Silence what Orbax prints about a save that fails; the error that it raises says enough."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def failing() -> Iterator[None]:
    """Keep Orbax from printing tracebacks of a save that fails, within a `with` statement.

    TensorStore's threads may report to Orbax's event loop after it was closed, for a moment after the failure, too: so
    only a save that succeeds lets such reports be printed again.
    """
    absl, hook = logging.getLogger("absl"), sys.unraisablehook
    level = absl.level

    def report(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            hook(unraisable)

    absl.setLevel(logging.CRITICAL)
    sys.unraisablehook = report
    try:
        yield
        sys.unraisablehook = hook
    finally:
        absl.setLevel(level)
