"""Checks of an observation that a user provides."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import numpy as np

from dipn_jax.errors import UserError
from dipn_jax.structs import ABSENT, Observation
from dipn_jax.system import forking
from dipn_jax.workspace import LOWEST_TIP, WORKSPACE

F = TypeVar("F", bound=Callable[..., Any])
MIN_HEIGHT = -0.05
"""Lowest height that is accepted (metres above the table)."""
LOWEST_PIXEL_LIMIT = 0.1
"""Height in metres that some pixel must not exceed: a heap never covers the whole table."""
MAX_HEIGHT = 1.0
"""Highest height that is accepted (metres above the table); heights given in millimetres exceed it."""
MAX_SLOTS = 4096
"""Most object slots that are accepted: each takes memory."""


def check_observation(observation: Any) -> None:
    """Raise an error with one line for an observation that no network can judge.

    Policies of `dipn_jax.load_policy`, `dipn_jax.decide` and `dipn_jax.imagine` do this by themselves.

    Example:
      dipn_jax.check_observation(dipn_jax.Observation(height, color, label, slots=10))

    Args:
      observation: a `dipn_jax.Observation` of one table.

    Raises:
      UserError: a map has another shape or kind of number, is not finite, heights are not in metres, colours not in
        [0, 1], or labels not below `slots`.
    """
    if not isinstance(observation, Observation):
        raise UserError(f"observation: {type(observation).__name__}, want a dipn_jax.Observation")
    side, slots = WORKSPACE.pixels, observation.slots
    height = _map("height", observation.height, (side, side), np.floating, "metres above the table")
    color = _map("color", observation.color, (side, side, 3), np.floating, "RGB from 0 to 1")
    label = _map("label", observation.label, (side, side), np.signedinteger, f"object slots, {ABSENT} on the table")
    if not isinstance(slots, (int, np.integer)) or not 1 <= slots <= MAX_SLOTS:
        raise UserError(
            f"observation.slots: {slots!r}; want how many objects there may be, a whole number from 1 to {MAX_SLOTS}"
        )
    if height.max() > MAX_HEIGHT or height.min() < MIN_HEIGHT:
        raise UserError(
            f"observation.height: {height.min():g} to {height.max():g}; want metres above the table, not millimetres "
            "and not the distance from the camera"
        )
    if height.min() > LOWEST_PIXEL_LIMIT:
        raise UserError(
            f"observation.height: at least {height.min():g} everywhere, so that no table is seen; want metres above "
            "the table, not the distance from the camera"
        )
    if color.max() > 1 or color.min() < 0:
        raise UserError(f"observation.color: {color.min():g} to {color.max():g}; want 0 to 1: divide bytes by 255")
    if label.max() >= slots or label.min() < ABSENT:
        raise UserError(
            f"observation.label: {label.min()} to {label.max()}; want {ABSENT} on the table and less than slots={slots}"
        )


def is_traced(observation: Any) -> bool:
    """Return whether this is called while a program is traced, when there are no numbers yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(observation))


def guarded(function: F, *, refuse_low_tables: bool = False) -> F:
    """Return a compiled function that first checks its argument `observation`, unless it is being traced; a decorator.

    A forked process in which JAX would hang is refused, too (`forking.check`).

    Args:
      function: has an argument `observation`.
      refuse_low_tables: also refuse a table on which nothing is high enough to be grasped.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*positional: Any, **named: Any) -> Any:
        given = signature.bind(*positional, **named).arguments["observation"]
        if not is_traced(given):
            forking.check()
            check_observation(given)
            if refuse_low_tables:
                require_graspable_height(given)
        return function(*positional, **named)

    return cast(F, checked)


def require_graspable_height(observation: Observation) -> None:
    """Raise a UserError where there are objects, and none is high enough for the fingers to close on."""
    objects = np.asarray(observation.label) != ABSENT
    highest = np.asarray(observation.height)[objects].max(initial=-np.inf)
    if objects.any() and highest <= LOWEST_TIP:
        raise UserError(
            f"observation: no object is higher than {1000 * highest:.0f} mm, and the fingers close "
            f"{1000 * LOWEST_TIP:.0f} mm above the table; take away what lies flat, or label it {ABSENT}"
        )


def _map(name: str, values: Any, shape: tuple[int, ...], kind: type, about: str) -> np.ndarray:
    """Return a map as a NumPy array, once its shape and kind are right and it is finite."""
    if not isinstance(values, (np.ndarray, np.generic, jax.Array)):
        raise UserError(f"observation.{name}: {type(values).__name__}, want an array of NumPy or JAX: {about}")
    if holes := int(np.ma.count_masked(values)) if isinstance(values, np.ma.MaskedArray) else 0:
        raise UserError(f"observation.{name}: {holes} values are masked; fill holes before, say with .filled(0)")
    array = np.asarray(values)
    if array.shape != shape:
        raise UserError(
            f"observation.{name}: has shape {array.shape}, want {shape}; crop and scale it to the workspace"
        )
    if not np.issubdtype(array.dtype, kind) and not (kind is np.floating and array.dtype.name == "bfloat16"):
        wanted = "floating-point numbers" if kind is np.floating else "whole numbers with a sign"
        raise UserError(f"observation.{name}: holds {array.dtype}, want {wanted}: {about}")
    if not array.dtype.isnative:  # JAX would take its bytes as they stand
        raise UserError(
            f"observation.{name}: holds {array.dtype.str}, the byte order of other machines; want this one's: "
            f".astype(np.{array.dtype.name})"
        )
    if not np.isfinite(array).all():
        holes = int((~np.isfinite(array)).sum())
        raise UserError(f"observation.{name}: {holes} values are NaN or infinite; fill holes before, say with 0")
    return array
