"""The commands that look after a data set: verify, repair and info; and the words of a command that makes one."""

from __future__ import annotations

import dataclasses
import inspect
import json
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import tyro

from dipn_jax import console
from dipn_jax.errors import UserError

MOST_SHOWN = 2000
"""Episodes on a page at most: about 10 MB."""


def verify(folder: tyro.conf.Positional[pathlib.Path]) -> None:
    """Check every shard, and that all episodes that were asked for are there; exit 2 if something is wrong.

    Sizes, SHA-256 and columns of the shards are held against the manifest; a shard that no worker has made is named,
    with the command that makes it.

    Args:
      folder: a data set.
    """
    from dipn_jax.storage import records

    problems = records.verify(folder)
    if problems:
        path, what = problems[0]
        raise UserError(f"{path}: {what} ({len(problems)} such in all); {records.advice(folder, problems)}")
    if said := records.missing(folder):
        raise UserError(said)
    console.say(f"{folder}: all shards are whole")


def repair(folder: tyro.conf.Positional[pathlib.Path]) -> None:
    """Set damaged shards aside and rebuild the manifest; the command that made the data set then fills the gaps.

    Args:
      folder: a data set.
    """
    from dipn_jax.storage import records

    removed = records.repair(folder)
    console.say(f"{folder}: {len(removed)} damaged shards set aside {[p.name for p in removed]}")
    console.say(records.missing(folder) or f"{folder}: nothing is missing")


def info(
    folder: tyro.conf.Positional[pathlib.Path],
    html: pathlib.Path | None = None,
    sample: int = 100,
    seed: int = 0,
) -> None:
    """Print what a data set holds, as JSON: episodes, bytes, config, faults counted, and who made it.

    `made_by` lists every combination of versions and kind of processor. On standard error, a line says where they
    differ, and one what is missing of the episodes that were asked for.

    One page for a browser, with counts of what was drawn, and pictures to be sifted by fault, shape and outcome:
      dipn-datagen info data/push --html push.html --sample 200

    Args:
      folder: a data set.
      html: file of the page, which needs no other.
      sample: episodes on the page, drawn at random.
      seed: of that draw.
    """
    from dipn_jax.storage import accounting, records

    console.require_between(1, MOST_SHOWN, sample=sample)
    console.require_seed(seed)
    summary = records.summary(folder)
    if html is not None:
        from . import browsing

        if html.is_dir():
            raise UserError(f"--html {html}: is a folder; give the name of a file")
        browsing.write(folder, html, sample=sample, seed=seed)
    console.say(json.dumps(summary, indent=1))
    mixed = accounting.mixed(summary["made_by"])
    for said in (mixed and f"{folder}: {mixed}", summary["missing"]):
        if said:
            console.warn(said)


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
                found += [f"--{option.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,))]
    return tuple(found)


def _changed(name: str, value: Any, default: Any) -> Iterator[tuple[str, Any]]:
    """Return the options of an argument that are not at their default: itself, or fields of the struct that it is."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _changed(field.name, getattr(value, field.name), getattr(default, field.name))
    elif value != default:
        yield name, value
