"""Prepare a command's environment variables, streams and terminal.

Importing this imports no JAX, which reads its settings from the environment when it is first imported.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import shutil
import sys

from dipn_jax.system import typed

IGNORED_JAX_SETTINGS = (
    "JAX_DEFAULT_DTYPE_BITS",
    "JAX_DEFAULT_MATMUL_PRECISION",
    "JAX_DEFAULT_PRNG_IMPL",
    "JAX_ENABLE_CUSTOM_PRNG",
    "JAX_ENABLE_X64",
    "JAX_EXPLICIT_X64_DTYPES",
    "JAX_HIGH_DYNAMIC_RANGE_GUMBEL",
    "JAX_LEGACY_PRNG_KEY",
    "JAX_NUMPY_DTYPE_PROMOTION",
    "JAX_NUMPY_RANK_PROMOTION",
    "JAX_RANDOM_SEED_OFFSET",
    "JAX_SOFTMAX_CUSTOM_JVP",
    "JAX_THREEFRY_PARTITIONABLE",
    "JAX_TRANSFER_GUARD",
    "JAX_TRANSFER_GUARD_DEVICE_TO_DEVICE",
    "JAX_TRANSFER_GUARD_DEVICE_TO_HOST",
    "JAX_TRANSFER_GUARD_HOST_TO_DEVICE",
)
"""Settings of JAX that change which numbers are drawn or computed, or forbid what we do; no result may depend on them.
"""
NARROWEST = 40
"""Columns that help and messages take at least; with a few, drawing their frames takes for ever."""


def set_environment() -> str | None:
    """Set environment variables for a command; return one line on the ignored JAX settings, None if there are none.

    Settings of packages that have been imported already are left alone.
    """
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    if "mujoco" not in sys.modules:  # it would load what draws on a screen, which need not be there
        os.environ["MUJOCO_GL"] = "disable"
    if "jax" in sys.modules:
        return None
    there = {name: os.environ.pop(name) for name in IGNORED_JAX_SETTINGS if name in os.environ}
    return f"{_shown(there)}: ignored, because results would differ or fail" if there else None


def open_streams() -> None:
    """Open the null device for each standard stream that is closed, and let the output streams take any text.

    Where one is closed, the next file that is opened would have its number, and get what libraries print. Output is
    UTF-8 where the locale knows ASCII only; names of files keep the bytes that they have.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(nowhere, "w" if number else "r", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            known = codecs.lookup(stream.encoding).name
            if known in ("ascii", "utf-8"):
                stream.reconfigure(encoding="utf-8", errors="surrogateescape")
            else:
                stream.reconfigure(errors="backslashreplace")


def print_error(text: str) -> None:
    """Print a line on standard error; do nothing if it cannot be written to."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def jax_problem(error: Exception) -> str | None:
    """Return what keeps JAX from being imported or from finding a device to compute on; None where nothing does.

    Args:
      error: what ended the command.
    """
    return _not_imported(error) if "jax" not in sys.modules else _missing_device()


def _not_imported(error: Exception) -> str | None:
    """Return why JAX cannot be imported, with its settings: most often JAX does not know one of them."""
    ours = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    try:
        import jax  # noqa: F401
    except Exception:  # an import that fails once more has another reason
        there = {name: value for name, value in os.environ.items() if name.startswith("JAX_") and name not in ours}
        advice = "unset what is wrong" if there else "install it again"
        why = " ".join(str(error).split()) or type(error).__name__
        return f"{_shown(there) or 'JAX'}: JAX cannot be imported ({why}); {advice}"
    return None


def _missing_device() -> str | None:
    """Return what is wrong where JAX has been imported and finds no device to compute on; else None."""
    try:
        sys.modules["jax"].devices()
    except Exception as error:  # an AssertionError without a word, where no plug-in knows the platform
        asked = os.environ.get("JAX_PLATFORMS")
        given = f"JAX_PLATFORMS={asked}" if asked else "JAX"
        why = " ".join(str(error).split()).split(" (set JAX_PLATFORMS")[0]
        return f"{given}: no such device here{f' ({why})' if why else ''}; unset JAX_PLATFORMS, or set it to cpu"
    return None


def _shown(settings: dict[str, str]) -> str:
    return ", ".join(f"{name}={typed.one_line(value)}" for name, value in sorted(settings.items()))
