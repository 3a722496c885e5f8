"""The paths on a command line: absolute when a command begins, none of them empty, and files of the right kind."""

from __future__ import annotations

import functools
import inspect
import itertools
import os
import pathlib
import typing
from collections.abc import Callable, Sequence
from typing import Any

from tyro import constructors

from dipn_jax.errors import UserError
from dipn_jax.system import addresses, files


def absolute(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return `command` with the paths among its arguments made absolute before it begins."""

    @functools.wraps(command)
    def called(*positional: Any, **named: Any) -> Any:
        hints = typing.get_type_hints(inspect.unwrap(command), include_extras=True)
        options = inspect.signature(command).bind(*positional, **named).arguments
        for name, value in options.items():
            options[name] = files.with_absolute_paths(value, urls=addresses.accepts_urls(hints.get(name)))
        return command(**options)

    return called


def require_file(path: pathlib.Path, *suffixes: str, option: str) -> None:
    """Raise a UserError if an option cannot name a file to write; creates nothing.

    Args:
      path: the file.
      suffixes: how its name may end, so that no file of another kind is written over by mistake.
      option: name of the option.
    """
    given = f"--{option} {path}"
    if path.is_dir():
        raise UserError(f"{given}: a folder; give the name of a file, such as {path / f'{path.name}{suffixes[0]}'}")
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{given}: want a file whose name ends in {' or '.join(suffixes)}")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise UserError(f"{given}: no file can be written in {folder}; give another folder")


def registry(arguments: Sequence[str]) -> constructors.ConstructorRegistry:
    """Return tyro's constructors for a command line with the words `arguments`: paths of them may not be empty.

    `pathlib` takes an empty text for the folder that we are in, and does not tell it from `.` afterwards.
    """
    found = constructors.ConstructorRegistry()

    def path(words: list[str]) -> pathlib.Path:
        if words[0]:
            return pathlib.Path(words[0])
        raise UserError(f"{_before_empty(arguments)}{files.EMPTY_PATH_MESSAGE}")

    @found.primitive_rule
    def rule(kind: constructors.PrimitiveTypeInfo) -> constructors.PrimitiveConstructorSpec[pathlib.Path] | None:
        if kind.type is not pathlib.Path:
            return None
        return constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="PATH",
            instance_from_str=path,
            is_instance=lambda value: isinstance(value, pathlib.Path),
            str_from_instance=lambda value: [str(value)],
        )

    return found


def _before_empty(arguments: Sequence[str]) -> str:
    """Return the options on a command line whose value is empty, each with a space behind it."""
    apart = [word for word, value in itertools.pairwise(arguments) if not value and word.startswith("--")]
    joined = [word[:-1] for word in arguments if word.startswith("--") and word.endswith("=")]
    return "".join(f"{option} " for option in (*apart, *joined))
