"""Signals that end work: what a terminal or a job manager sends, taken as an interruption."""

from __future__ import annotations

import signal
import threading
from typing import Any

STOPS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name))
"""Signals that ask to stop as SIGINT does: a job manager's, a closed terminal's, a time limit's warning."""


def stops() -> list[signal.Signals]:
    """Return the signals of STOPS that are heeded: all, but none that is ignored because `nohup` asked for it."""
    return [number for number in STOPS if signal.getsignal(number) != signal.SIG_IGN]


class Interruption:
    """A context in which the first SIGINT or signal of STOPS only sets `requested`; a second one acts as usual."""

    def __init__(self) -> None:
        self.requested = False
        self._old: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *stops()):
                self._old[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _request(self, *_: object) -> None:
        self.requested = True
        self.__exit__()
