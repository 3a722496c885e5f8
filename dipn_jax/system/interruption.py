"""Signals that end work: what a terminal or a job manager sends, taken as an interruption."""

from __future__ import annotations

import os
import signal
import sys
import threading
from typing import Any

STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name))
"""Signals that ask to stop as SIGINT does: a job manager's, a closed terminal's, a time limit's warning."""


def stops() -> list[signal.Signals]:
    """Return the signals of STOP_SIGNALS that are heeded: all but those that are ignored, as `nohup` asks."""
    return [number for number in STOP_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]


AGAIN_AFTER = 0.05
"""Seconds after which a signal is sent again whose KeyboardInterrupt was lost."""


class Stopping:
    """A context in which SIGINT and the signals of STOP_SIGNALS raise KeyboardInterrupt.

    Where it is raised within a callback, as JAX has one at each garbage collection, Python prints it and
    continues: then the signal is sent again instead. Handlers stay in place at the end.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        """The signal that came, if one did."""
        self._hook = sys.unraisablehook

    def __enter__(self) -> Stopping:
        if threading.current_thread() is threading.main_thread():
            usual = signal.getsignal(signal.SIGINT) == signal.default_int_handler
            for number in (*([signal.SIGINT] if usual else []), *stops()):
                signal.signal(number, self._stop)
            self._hook, sys.unraisablehook = sys.unraisablehook, self._lost
        return self

    def __exit__(self, *_: object) -> None:
        if sys.unraisablehook == self._lost:
            sys.unraisablehook = self._hook

    def _stop(self, number: int, _: object) -> None:
        self.number = number
        raise KeyboardInterrupt

    def _lost(self, lost: Any) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            number = self.number or signal.SIGINT
            again = threading.Timer(AGAIN_AFTER, lambda: os.kill(os.getpid(), number))
            again.daemon = True
            again.start()
        else:
            self._hook(lost)


class Interruption:
    """A context in which the first SIGINT or signal of STOP_SIGNALS only sets `requested`; a second acts as usual."""

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
