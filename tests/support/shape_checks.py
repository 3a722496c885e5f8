"""The type checker that the import hook puts on every function of the library in tests: beartype, and structs.

Four things that beartype alone does not do:

- an axis of a field is the same as the axis of that name in the other arguments: a scene of five objects with poses of
  six is an error. Leading batch axes (`*b`) belong to one struct;
- JAX rebuilds structs around leaves that are not arrays (`None`, `object()`, shapes, axes of `vmap`), so a field is
  checked only where it holds an array;
- a number of NumPy does where a Python number is wanted, and an `int` where a `float` is;
- an array without a shape may be one of JAX or of NumPy, and an `Array` a number.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import beartype
import jax
import jaxtyping
import numpy as np

ARRAYS = (jax.Array, np.ndarray, np.generic)


class _Any(type):
    def __instancecheck__(cls, value: object) -> bool:
        return isinstance(value, ARRAYS)


class AnyArray(metaclass=_Any):
    """An array of JAX or of NumPy."""


WIDER = {bool: bool | np.bool_, int: int | np.integer, float: float | int | np.floating | np.integer}
WIDER |= {jax.Array: AnyArray, np.ndarray: AnyArray}
_beartype = beartype.beartype(conf=beartype.BeartypeConf(hint_overrides=beartype.BeartypeHintOverrides(WIDER)))


class _Other(type):
    def __instancecheck__(cls, value: object) -> bool:
        return not isinstance(value, ARRAYS)


class NoArray(metaclass=_Other):
    """Anything that is not an array."""


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with its arguments and its result checked on every call."""
    hints = function.__annotations__
    hints = {name: Any if set(_parts(hint)) == set(ARRAYS) else hint for name, hint in hints.items()}
    if function.__name__ == "__init__":
        function.__annotations__ = {k: hint | NoArray if _is_shaped(hint) else hint for k, hint in hints.items()}
        return _beartype(function)
    function.__annotations__ = hints
    checked = _beartype(function)
    structs = {name for name, hint in hints.items() if _is_struct(hint)}
    if not structs:
        return checked
    signature = inspect.signature(function)

    @functools.wraps(function)
    def with_fields(*args: Any, **kwargs: Any) -> Any:
        arguments = signature.bind(*args, **kwargs).arguments
        for name in structs & set(arguments):
            _check_fields(arguments[name], name)
        result = checked(*args, **kwargs)
        if "return" in structs:
            _check_fields(result, "return")
        return result

    return with_fields


def _check_fields(struct: Any, place: str) -> None:
    """Bind the axes of a struct's fields to those of the call that is being checked."""
    if not _is_struct(type(struct)):
        return
    for name, hint in _fields(type(struct)):
        value, where = getattr(struct, name), f"{place}.{name}"
        _check_fields(value, where)
        if isinstance(value, ARRAYS) and not any(isinstance(value, part) for part in _parts(hint)):
            raise TypeError(f"{where} {value.dtype}{list(value.shape)}: want {_text(hint)}")


@functools.cache
def _fields(struct: type) -> list[tuple[str, Any]]:
    """Fields and their types, any batch axes allowed."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return [(field.name, _without_batch(hints[field.name])) for field in dataclasses.fields(struct)]


def _without_batch(hint: Any) -> Any:
    parts = [
        part.dtype[part.array_type, part.dim_str.replace("*b", "...")] if _is_array(part) else part
        for part in _parts(hint)
    ]
    return functools.reduce(operator.or_, parts)


def _parts(hint: Any) -> Iterator[Any]:
    yield from typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)


def _is_struct(hint: Any) -> bool:
    return isinstance(hint, type) and hasattr(hint, "_flax_dataclass")


def _is_shaped(hint: Any) -> bool:
    return _is_struct(hint) or any(_is_array(part) or part in ARRAYS for part in _parts(hint))


def _text(hint: Any) -> str:
    return " or ".join(f"{p.dtype.__name__}[{p.dim_str}]" if _is_array(p) else str(p) for p in _parts(hint))
