"""The type checker that the import hook applies to every function of the library in tests: beartype, for shapes only.

Only annotations that say a shape are looked at (`Float[Array, "N 3"]`, or a struct that has such fields); what else a
function is given, mypy and the tests of its errors see to. Three things that beartype alone does not do:

- an axis of a field is the same as the axis of that name in the other arguments: a scene of five objects with poses of
  six is an error. Leading batch axes (`*b`) belong to one struct;
- JAX rebuilds structs around leaves that are not arrays (`None`, `object()`, shapes, axes of `vmap`), so a field is
  checked only where it holds an array;
- an array of NumPy does where one of JAX is wanted, and the other way round, as in JAX.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
import types
import typing
from collections.abc import Callable
from typing import Any

import beartype
import jax
import jaxtyping
import numpy as np


class _Kind(type):
    def __instancecheck__(cls, value: object) -> bool:
        return isinstance(value, (jax.Array, np.ndarray, np.generic)) == (cls is AnArray)


class AnArray(metaclass=_Kind):
    """Any array of JAX or NumPy."""


class NoArray(metaclass=_Kind):
    """Anything that is not an array."""


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` with a check of the shapes of its arguments and result on every call."""
    hints = function.__annotations__
    structs = [name for name, hint in hints.items() if name != "return" and any(map(_is_struct, _parts(hint)))]
    shaped = {name: _of_any_array(hint) for name, hint in hints.items() if _says_shape(hint)}
    if function.__name__ == "__init__":
        shaped, structs = {name: hint | NoArray for name, hint in shaped.items()}, []
    if not shaped and not structs:
        return function
    function.__annotations__ = {name: shaped.get(name, Any) for name in hints}
    checked = beartype.beartype(function)
    signature = inspect.signature(function)

    @functools.wraps(function)
    def with_fields(*args: Any, **kwargs: Any) -> Any:
        arguments = signature.bind(*args, **kwargs).arguments
        for name in structs:
            _check_fields(arguments.get(name), name)
        return checked(*args, **kwargs)

    return with_fields if structs else checked


def _check_fields(struct: Any, place: str) -> None:
    """Bind the axes of a struct's fields to those of the call that is being checked."""
    if not _is_struct(type(struct)):
        return
    for name, hint in _fields(type(struct)):
        value, where = getattr(struct, name), f"{place}.{name}"
        _check_fields(value, where)
        if isinstance(value, AnArray) and _says_shape(hint) and not any(isinstance(value, p) for p in _parts(hint)):
            raise TypeError(f"{where} {value.dtype}{list(value.shape)}: want {hint}")


@functools.cache
def _fields(struct: type) -> list[tuple[str, Any]]:
    """Return the fields and their types, with any batch axes."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return [(field.name, _of_any_array(hints[field.name], batch="...")) for field in dataclasses.fields(struct)]


def _of_any_array(hint: Any, *, batch: str = "*b") -> Any:
    """Return the same type for arrays of any kind, with `batch` as the batch axes."""
    if _is_array(hint):
        return hint.dtype[AnArray, hint.dim_str.replace("*b", batch)]
    if not _says_shape(hint):
        return hint
    arguments = [_of_any_array(part, batch=batch) for part in typing.get_args(hint) if part is not np.generic]
    if len(_parts(hint)) > 1:
        return functools.reduce(operator.or_, arguments)
    return typing.get_origin(hint)[tuple(arguments)]


def _parts(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)


def _is_struct(hint: Any) -> bool:
    return isinstance(hint, type) and hasattr(hint, "_flax_dataclass")


def _says_shape(hint: Any) -> bool:
    """Return whether a type contains an array of a given shape."""
    return _is_array(hint) or any(_says_shape(part) for part in typing.get_args(hint))
