"""What the three commands share with a terminal: progress, one-line errors, the compilation cache.

The only module of the library that prints, and with `records` and `checkpoint` the only ones that know folders.
"""

from __future__ import annotations

import math
import os
import pathlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import jax
import rich.progress
import tyro

from dipn_jax.errors import UserError

LOG_PERIOD = 10.0
"""Seconds between progress lines where there is no terminal."""


def enable_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`)."""
    home = os.environ.get("XDG_CACHE_HOME") or str(pathlib.Path.home() / ".cache")
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(pathlib.Path(home) / "dipn-jax" / "xla")
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


class Progress:
    """A bar on a terminal, a line every few seconds in a log. Use as a context manager."""

    def __init__(self, title: str, total: int, *, unit: str, done: int = 0) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.done, self.begun_at = done, done
        self.note = ""
        self._bar: rich.progress.Progress | None = None
        if sys.stderr.isatty():
            self._bar = rich.progress.Progress(
                rich.progress.TextColumn("{task.description}"),
                rich.progress.BarColumn(),
                rich.progress.MofNCompleteColumn(),
                rich.progress.TextColumn("{task.fields[rate]}"),
                rich.progress.TextColumn("{task.fields[note]}"),
                rich.progress.TimeRemainingColumn(),
                console=rich.console.Console(stderr=True),
            )
            self._task = self._bar.add_task(title, total=total, completed=done, rate="", note="")
        self._begun = time.monotonic()
        self._logged = self._begun
        self._lock = threading.Lock()

    def __enter__(self) -> Progress:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()
        elif kind is None:
            self._line()

    def advance(self, amount: int, note: str = "") -> None:
        """`amount` more are done; `note` is shown beside the count. Any thread may call."""
        with self._lock:
            self.done += amount
            self.note = note
            if self._bar:
                rate = f"{self._rate():.1f} {self.unit}/s"
                self._bar.update(self._task, completed=self.done, rate=rate, note=note)
            elif time.monotonic() - self._logged > LOG_PERIOD:
                self._line()

    def _rate(self) -> float:
        return (self.done - self.begun_at) / max(time.monotonic() - self._begun, 1e-9)

    def _line(self) -> None:
        self._logged = time.monotonic()
        rate = self._rate()
        left = (self.total - self.done) / rate if rate > 0 else float("inf")
        note = f", {self.note}" if self.note else ""
        print(
            f"{self.title}: {self.done}/{self.total} {self.unit}, {rate:.1f}/s, {left:.0f} s left{note}",
            file=sys.stderr,
            flush=True,
        )


def say(text: str) -> None:
    """One line for the user, on standard output."""
    print(text, flush=True)


def require_positive(**values: float) -> None:
    """UserError for the first value that is not a finite number above zero."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise UserError(f"{_option(name)} {value}: want a number above 0")


def require_between(low: float, high: float, **values: float) -> None:
    """UserError for the first value outside [low, high]."""
    for name, value in values.items():
        if not low <= value <= high:
            raise UserError(f"{_option(name)} {value}: want {low} to {high}")


def require_seed(seed: int) -> None:
    """UserError for a seed that is not an unsigned 32-bit number."""
    require_between(0, 2**32 - 1, seed=seed)


def require_out(out: pathlib.Path) -> None:
    """UserError where a folder `out` cannot be made or written to; makes nothing."""
    existing = next(p for p in (out, *out.resolve().parents) if p.exists())
    if not existing.is_dir():
        raise UserError(f"--out {out}: {existing} is not a folder; give another")
    if not os.access(existing, os.W_OK):
        raise UserError(f"--out {out}: {existing} cannot be written to; give another")


def _option(name: str) -> str:
    return f"--{name.rstrip('_').replace('_', '-')}"


class Interruption:
    """Within it, the first SIGINT or SIGTERM only sets `requested`; a second one acts as usual."""

    def __init__(self) -> None:
        self.requested = False
        self._old: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._old[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _request(self, *_: object) -> None:
        self.requested = True
        self.__exit__()


def run(description: str, commands: dict[str, Any], arguments: Sequence[str] | None = None) -> int:
    """Parse and run one of `commands`; returns the exit code, as `exit_code` does."""
    enable_compilation_cache()

    def work() -> None:
        tyro.extras.subcommand_cli_from_dict(
            commands, description=description, args=arguments, config=(tyro.conf.OmitArgPrefixes,)
        )

    return exit_code(work)


def exit_code(work: Callable[[], int | None]) -> int:
    """Do a command's work and turn what stops it into the exit code of the process.

    Returns:
      What `work` returns, or 0 if that is None; 2 after one line on standard error for a mistake of the user's; 130
      when interrupted (what was written before stays valid, and the same command continues).
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a job manager's stop is an interruption
    try:
        try:
            return work() or 0
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # who reads what we say, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(
            f"error: {error.filename or 'files'}: {error.strerror or error}; mend that and try again", file=sys.stderr
        )
        return 2
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from here", file=sys.stderr)
        return 130
