"""Parse JSON that is read back from files, and check it against a form.

Whatever is in a file, reading it ends with a value that fits, or with a `Misfit` of one line, never with another error.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pathlib
from typing import Any, TypeAlias

Form: TypeAlias = Any
"""What a value has to be.

`int`, `float` (finite; a whole number, too), `str`, `bool`, `list`, `dict`, or `object` for anything;
`Whole(low, high)` and `Maybe(form)`; `{"push", "grasp"}`, one of these; `[form]`, a list; `(form, form)`, a list of
just these; `{"key": form, "other?": form}`, an object with these keys, the second of which may be absent, and any
others; `{str: form}`, an object whose keys are any.
"""
_NAMES: dict[type, str] = {
    int: "a whole number",
    float: "a finite number",
    str: "text",
    bool: "true or false",
    list: "a list",
    dict: "an object",
}
_MOST = 2**63 - 1


class Misfit(ValueError):
    """A text that is no JSON, or a value that does not fit: one line that says where, what it is and what is wanted."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """The form of a whole number from `low` to `high`."""

    low: int = 0
    high: int = _MOST


@dataclasses.dataclass(frozen=True)
class Maybe:
    """The form of a value that may be null."""

    form: Form


def parse(text: str | bytes) -> Any:
    """Return what a JSON text holds: UTF-8 with or without a byte-order mark, no key twice, every number finite.

    Raises:
      Misfit: it is no JSON.
    """
    try:
        text = text.decode("utf-8-sig") if isinstance(text, bytes) else text
        return json.loads(text, parse_constant=_finite, parse_float=_finite, object_pairs_hook=_without_repeats)
    except UnicodeDecodeError:
        raise Misfit("not JSON (not UTF-8)") from None
    except RecursionError:
        raise Misfit("not JSON that can be used (nested too deeply)") from None
    except ValueError as error:
        raise Misfit(f"not JSON ({str(error).splitlines()[0]})") from None


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise a ValueError for a key that is there twice, of which Python keeps the last value."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{brief(next(key for key in keys if keys.count(key) > 1))} is there twice in one object")
    return found


def _finite(text: str) -> float:
    """Return the number that a text stands for."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{brief(text)} is not a finite number")
    return number


def check(value: Any, form: Form, *, at: str = "") -> Any:
    """Return `value` if it fits `form`.

    Args:
      value: as from `parse`.
      form: see `Form`.
      at: where the value stands, for the message.

    Raises:
      Misfit: it does not fit.
    """
    if form is object:
        return value
    if isinstance(form, Maybe):
        return value if value is None else check(value, form.form, at=at)
    if isinstance(form, type):
        form_is_met = type(value) is form or (form is float and type(value) is int)
        if not form_is_met or not _usable(value):
            raise _misfit(value, _NAMES[form], at)
    elif isinstance(form, Whole):
        if type(value) is not int or not form.low <= value <= form.high:
            upper = "" if form.high == _MOST else f" to {form.high}"
            raise _misfit(value, f"a whole number, {form.low}{upper or ' or more'}", at)
    elif isinstance(form, (set, frozenset)):
        if not isinstance(value, str) or value not in form:
            raise _misfit(value, f"one of {', '.join(sorted(form))}", at)
    elif isinstance(form, dict):
        _check_object(value, form, at)
    else:
        _check_list(value, form, at)
    return value


def _usable(value: Any) -> bool:
    """Return whether a number is finite and of a size that arrays have, and a text is one that can be written."""
    if isinstance(value, str):
        try:
            value.encode("utf-8", "surrogateescape")
        except UnicodeEncodeError:  # half a pair of surrogates
            return False
    if type(value) is int:
        return -_MOST <= value <= _MOST
    return not isinstance(value, float) or math.isfinite(value)


def _check_object(value: Any, form: dict[Any, Form], at: str) -> None:
    if not isinstance(value, dict):
        raise _misfit(value, "an object", at)
    if set(form) == {str}:
        for key, each in value.items():
            check(each, form[str], at=_joined(at, brief(key)))
        return
    for name, each in form.items():
        key = name.removesuffix("?")
        if key in value:
            check(value[key], each, at=_joined(at, key))
        elif not name.endswith("?"):
            raise Misfit(f"{_joined(at, key)} is missing")


def _check_list(value: Any, form: list[Form] | tuple[Form, ...], at: str) -> None:
    wanted = "a list" if isinstance(form, list) else f"a list of {len(form)}"
    if not isinstance(value, list) or (isinstance(form, tuple) and len(value) != len(form)):
        raise _misfit(value, wanted, at)
    each = form * len(value) if isinstance(form, list) else form
    for number, (one, its) in enumerate(zip(value, each, strict=True)):
        check(one, its, at=f"{at}[{number}]")


def _joined(at: str, key: str) -> str:
    return f"{at}.{key}" if at else key


def _misfit(value: Any, wanted: str, at: str) -> Misfit:
    return Misfit(f"{at or 'its content'} is {brief(value)}, want {wanted}")


def brief(value: Any) -> str:
    """Return a value as text for a message: short, on one line, and such that it can be printed."""
    if isinstance(value, (dict, list)):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    if isinstance(value, int) and abs(value) > _MOST:
        return "a number of many digits"
    return one_line(value if isinstance(value, str) else json.dumps(value))


def one_line(text: str, *, most: int = 60) -> str:
    """Return a text on one line, of `most` characters at most, all of which can be printed."""
    if not (text.isascii() and text.isprintable()):
        text = text.encode("utf-8", "backslashreplace").decode()
        text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def inside(folder: pathlib.Path, name: str) -> pathlib.Path:
    """Return the path of a file that stands in `folder` under a name that was read from a file.

    The file may be a link, as in data sets of DVC, git-annex or the Hugging Face hub.

    Raises:
      Misfit: the name leads out of the folder: it is absolute, or has `..`.
    """
    parts = pathlib.PurePosixPath(name).parts
    plain = bool(parts) and not name.startswith("/") and ".." not in parts and "\\" not in name
    try:
        short = max(map(len, os.fsencode(name).split(b"/"))) < 256 and len(name) < 1024
    except UnicodeEncodeError:
        short = False
    if plain and short and name.isprintable():
        return folder / name
    raise Misfit(f"{brief(name)} is no file inside {folder}")
