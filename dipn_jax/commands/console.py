"""What the three commands need to talk to a terminal: progress, help, one-line errors, the compilation cache.

The only module of the library that prints. Importing it imports no JAX, so that `--help` answers at once.
"""

from __future__ import annotations

import inspect
import itertools
import os
import pathlib
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_type_hints

import tyro

from dipn_jax.commands import option_paths, surroundings
from dipn_jax.errors import UserError
from dipn_jax.system import addresses, files
from dipn_jax.system.interruption import Stopping

if TYPE_CHECKING:
    import rich.progress

MAX_COUNT = 2**31 - 1
"""Largest value of an option that counts something."""
INTERRUPTED = "interrupted: run the same command again to continue from here"
"""What a command that was interrupted prints at its end."""
LOG_PERIOD = 10.0
"""Seconds between progress lines where there is no terminal."""


def enable_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`).

    Where JAX has not been imported yet, environment variables tell it, so that this does not import it.
    """
    # on some processors XLA logs an error for every program that it finds in the cache, though it runs them (openxla
    # issue 44565); it reads this variable when JAX is first imported
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # a cache that cannot be read or written, as a full disk's, costs time only; JAX would say so for every program
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")
    home = files.cache()
    if home is None:  # as in some containers: nothing is kept
        return
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(home / "xla")
    settings = {"jax_compilation_cache_dir": folder, "jax_persistent_cache_min_compile_time_secs": 0.0}
    for name, value in settings.items():
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)
        else:
            os.environ[name.upper()] = str(value)


def prepare() -> None:
    """Prepare streams, environment and compilation cache for a command; warn of ignored JAX settings in one line."""
    surroundings.open_streams()
    if ignored := surroundings.set_environment():
        warn(ignored)
    enable_compilation_cache()


class Progress:
    """A progress bar on a terminal, a line every few seconds in a log; nothing if `quiet`. It is a context manager."""

    def __init__(self, title: str, total: int, *, unit: str, done: int = 0, quiet: bool = False) -> None:
        self.title, self.total, self.unit, self.quiet = title, total, unit, quiet
        self.done, self.begun_at = done, done
        self.note = ""
        self._bar: rich.progress.Progress | None = None
        if sys.stderr.isatty() and not quiet:
            import rich.progress

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
        elif kind is None and not self.quiet:
            self._line()

    def advance(self, amount: int, note: str = "") -> None:
        """Count `amount` more as done and show `note` beside the count. Any thread may call this."""
        with self._lock:
            self.done += amount
            self.note = note
            if self._bar:
                rate = f"{self._rate():.1f} {self.unit}/s"
                self._bar.update(self._task, completed=self.done, rate=rate, note=note)
            elif time.monotonic() - self._logged > LOG_PERIOD and not self.quiet:
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
    """Print one line for the user on standard output."""
    print(addresses.with_urls(text), flush=True)


def note(text: str) -> None:
    """Print one line for the user on standard error, about how far work is."""
    print(addresses.with_urls(text), file=sys.stderr, flush=True)


def warn(text: str) -> None:
    """Print one warning line on standard error; the command continues."""
    print(f"warning: {addresses.with_urls(text)}", file=sys.stderr, flush=True)


def require_positive(**values: float) -> None:
    """Raise a UserError for the first value that is no finite number above zero, or is a count over MAX_COUNT."""
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise UserError(f"{_option(name)} {value}: want a number above 0")
        if isinstance(value, int) and value > MAX_COUNT:
            raise UserError(f"{_option(name)} {value:.3g}: want a number above 0 and at most {MAX_COUNT:,}")


def require_between(low: float, high: float, **values: float) -> None:
    """Raise a UserError for the first value outside [low, high]."""
    for name, value in values.items():
        if not low <= value <= high:
            raise UserError(f"{_option(name)} {value}: want {low} to {high}")


def require_seed(seed: int) -> None:
    """Raise a UserError if `seed` is not an unsigned 32-bit number."""
    require_between(0, 2**32 - 1, seed=seed)


def require_out(out: pathlib.Path) -> None:
    """Raise a UserError if the folder `out` cannot be made or written to; creates nothing."""
    existing = next(p for p in (out, *out.resolve().parents) if p.exists())
    if not existing.is_dir():
        raise UserError(f"--out {out}: {existing} is not a folder; give another")
    if not os.access(existing, os.W_OK):
        raise UserError(f"--out {out}: {existing} cannot be written to; give another")


def _option(name: str) -> str:
    return f"--{name.rstrip('_').replace('_', '-')}"


def _described(command: Callable[..., Any], *, whole: bool) -> str:
    """Return the text of a command's help: the first sentence of its docstring, or everything before `Args:`.

    Tyro joins a line that begins with a letter to the line before. So every paragraph becomes one line here and is set
    apart by a blank line; indented lines, which are examples to be copied, stay as they are below their paragraph.
    """
    text = inspect.cleandoc(command.__doc__ or "").split("\nArgs:")[0]
    first, *rest = text.strip().split("\n\n")
    result = " ".join(first.split())
    for paragraph in rest if whole else []:
        for is_example, group in itertools.groupby(paragraph.splitlines(), lambda line: line.startswith(" ")):
            lines = list(group)
            result += "\n" + "\n".join(lines) if is_example else "\n\n" + " ".join(lines)
    return result


def _joined(command: Callable[..., Any]) -> Any:
    """Return `command` with each option's text on one line of its docstring: tyro would keep the line ends in it."""
    called: Any = option_paths.absolute(command)
    text, head, options = inspect.cleandoc(command.__doc__ or "").partition("\nArgs:\n")
    called.__doc__ = text + head + re.sub(r"\n {4,}", " ", options)
    called.__signature__ = inspect.signature(command)
    called.__annotations__ = get_type_hints(inspect.unwrap(command), include_extras=True)
    del called.__wrapped__  # there tyro would read the docstring that is not joined
    return called


def run(description: str, commands: dict[str, Any], arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and call one of `commands`.

    Args:
      description: what the commands are for.
      commands: functions by the name that a user types; their docstrings are the help texts.
      arguments: the command line; that of this process if not given.

    Returns:
      The exit code, as `exit_code`.
    """
    prepare()
    return exit_code(lambda: _parse_and_call(description, commands, sys.argv[1:] if arguments is None else arguments))


def exit_code(work: Callable[[], int | None]) -> int:
    """Do a command's work and turn what stops it into the exit code of the process.

    Returns:
      What `work` returns, or 0 if that is None; 2 after one line on standard error for a mistake of the user's; 130
      when interrupted (what was written before stays valid, and the same command continues).
    """
    stopping = Stopping()
    try:
        with stopping:
            try:
                return work() or 0
            finally:
                sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output, such as `head`, has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except UserError as error:
        surroundings.print_error(f"error: {addresses.with_urls(str(error))}")
        return 2
    except OSError as error:
        surroundings.print_error(f"error: {UserError(addresses.with_urls(file_to_mend(error)))}")
        return 2
    except MemoryError:
        surroundings.print_error("error: not enough memory; make room, or ask for less at a time")
        return 2
    except KeyboardInterrupt:
        surroundings.print_error(INTERRUPTED)
        return 130
    except Exception as error:
        if stopping.number is not None:  # some library's own error for what interrupted it
            surroundings.print_error(INTERRUPTED)
            return 130
        trouble = surroundings.jax_problem(error)
        if trouble is None:
            raise
        surroundings.print_error(f"error: {UserError(trouble)}")
        return 2


def file_to_mend(error: OSError) -> str:
    """Return the line that says which file the user has to mend."""
    return f"{error.filename or 'files'}: {error.strerror or error}; mend that and try again"


def _parse_and_call(description: str, commands: dict[str, Any], arguments: Sequence[str]) -> int | None:
    """Call the command that `arguments` name and return what it returns.

    Its own help is complete; the list of all gives a sentence each.
    """
    choices = tuple(
        Annotated[
            Any,
            tyro.conf.subcommand(
                name,
                constructor=_joined(command),
                description=_described(command, whole=name in arguments[:1]),
            ),
        ]
        for name, command in commands.items()
    )
    one_of_them: Any = Union[choices]  # noqa: UP007  a tuple
    program = pathlib.Path(sys.argv[0]).name
    options = (tyro.conf.OmitArgPrefixes,)
    with option_paths.registry(arguments):
        code: int | None = tyro.cli(one_of_them, prog=program, description=description, args=arguments, config=options)
    return code
