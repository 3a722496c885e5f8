"""Python values as JSON and arrays, and back, without pickle: reading a file never runs what is in it."""

from __future__ import annotations

import dataclasses
import io
import json
import math
from typing import Any, TypeVar

import jax
import numpy as np

from dipn_jax import structs

T = TypeVar("T", bound=type)
_TYPES: dict[str, type] = {}


def register(cls: T) -> T:
    """Allow instances of a dataclass to be written and read; a decorator."""
    _TYPES[f"{cls.__module__}.{cls.__qualname__}"] = cls
    return cls


for _cls in (structs.Scene, structs.Push, structs.Grasp, structs.SettledScene):
    register(_cls)


def dumps(value: Any) -> bytes:
    """Return a value as the bytes of an `npz` file: `value` is its form in JSON, `0`, `1`, ... are its arrays.

    Args:
      value: None, numbers, text, arrays, registered dataclasses, and lists, tuples and dictionaries of these.

    Raises:
      TypeError: there is something else in it.
    """
    arrays: list[np.ndarray] = []
    text = json.dumps(_encode(value, arrays), allow_nan=False)
    stream = io.BytesIO()
    named = {str(number): array for number, array in enumerate(arrays)}
    np.savez(stream, allow_pickle=False, value=np.frombuffer(text.encode(), np.uint8), **named)
    return stream.getvalue()


def loads(data: bytes) -> Any:
    """Return the value that `dumps` turned into bytes; damaged bytes raise any `Exception`, but run nothing."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        return _decode(json.loads(stored["value"].tobytes().decode()), stored)


def _encode(value: Any, arrays: list[np.ndarray]) -> Any:
    """Return the form in JSON; arrays are appended to `arrays`. Whatever is not plain is `{kind: content}`."""
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        array = np.asarray(value)
        if array.dtype.kind not in "biufcU":
            raise TypeError(f"cannot keep an array of {array.dtype}")
        arrays.append(array)
        return {"scalar" if isinstance(value, np.generic) else "array": len(arrays) - 1}
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if type(value) is list:
        return [_encode(one, arrays) for one in value]
    if type(value) is tuple:
        return {"tuple": [_encode(one, arrays) for one in value]}
    if type(value) is dict:
        return {"dict": [[_encode(one, arrays) for one in pair] for pair in value.items()]}
    name = f"{type(value).__module__}.{type(value).__qualname__}"
    if _TYPES.get(name) is not type(value):
        raise TypeError(f"cannot keep a {name}; register it")
    fields = {field.name: _encode(getattr(value, field.name), arrays) for field in dataclasses.fields(_TYPES[name])}
    return {"type": name, "fields": fields}


def _decode(form: Any, arrays: Any) -> Any:
    """Return the value of a form in JSON."""
    if isinstance(form, list):
        return [_decode(one, arrays) for one in form]
    if not isinstance(form, dict):
        return form
    if "type" in form:
        return _TYPES[form["type"]](**{name: _decode(one, arrays) for name, one in form["fields"].items()})
    ((kind, content),) = form.items()
    if kind in ("array", "scalar"):
        array = arrays[str(content)]
        return array[()] if kind == "scalar" else array
    if kind == "float":
        return float(content)
    if kind == "tuple":
        return tuple(_decode(one, arrays) for one in content)
    if kind == "dict":
        return {_decode(key, arrays): _decode(one, arrays) for key, one in content}
    raise ValueError(f"{kind}: unknown kind")
