"""Write the options of a command as words of a command line, so that a result can record how to make it again."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

WORKER_OPTIONS = ("out", "shard", "of", "threads", "launcher", "num_cpus", "num_gpus")
"""Options in which the workers of one job may differ; all others they have in common."""


def words(command: Callable[..., Any], given: Mapping[str, Any], *, without: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the words after a command's name that give it the options `given`; those at their default are left out.

    Args:
      command: a function of the command line.
      given: its arguments by name.
      without: options to be left out.
    """
    found: list[str] = []
    for name, parameter in inspect.signature(command).parameters.items():
        for option, value in _changed(name, given[name], parameter.default):
            if option not in without:
                found += _words(option.rstrip("_").replace("_", "-"), value)
    return tuple(found)


def _words(option: str, value: Any) -> list[str]:
    """Return the words that set an option: a flag, or its name and its values."""
    if isinstance(value, bool):
        return [f"--{option}" if value else f"--no-{option}"]
    return [f"--{option}", *map(str, value if isinstance(value, tuple) else (value,))]


def _changed(name: str, value: Any, default: Any) -> Iterator[tuple[str, Any]]:
    """Return the options of an argument that differ from their defaults: the argument, or fields of its struct."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _changed(field.name, getattr(value, field.name), getattr(default, field.name))
    elif value != default:
        yield name, value
