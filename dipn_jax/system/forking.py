"""Detect processes that were forked after JAX was used: its threads are missing there, so JAX would wait for ever.

Functions that compute call `check` first, outside of compiled functions. Reading data sets needs no device and works in
such a process.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast

from dipn_jax.errors import UserError

F = TypeVar("F", bound=Callable[..., Any])
_forked_after_jax = False


def _note() -> None:
    """Note, in a forked child, whether JAX had begun to compute in its parent."""
    global _forked_after_jax
    bridge = sys.modules.get("jax._src.xla_bridge")
    _forked_after_jax |= bool(getattr(bridge, "_backends", None))


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_note)


def check() -> None:
    """Raise an error if this process was forked after JAX was used.

    Raises:
      UserError: this process was forked after JAX had been used.
    """
    if _forked_after_jax:
        raise UserError(
            "this process was forked after JAX had been used, so JAX would wait here for ever; start workers by spawn "
            "or forkserver, or read in workers and compute in the parent"
        )


def guarded(function: F) -> F:
    """Return `function` with a `check` before every call, for a compiled function; a decorator."""

    @functools.wraps(function)
    def checked(*positional: Any, **named: Any) -> Any:
        check()
        return function(*positional, **named)

    return cast(F, checked)
