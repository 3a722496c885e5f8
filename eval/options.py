"""Options of several commands of `dipn-eval`, their checks, and how results are written. Imports no JAX."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Any

from dipn_jax.commands import console

if TYPE_CHECKING:
    from dipn_jax.storage import resume


MOST_TABLES = 1_000_000
"""Most tables or scenes of an evaluation; they are listed before the first begins."""


def check(out: pathlib.Path, seed: int, **counts: int) -> None:
    """Raise a UserError for counts that are not positive, a wrong seed, or an `out` that cannot be a folder."""
    console.require_between(1, MOST_TABLES, **counts)
    console.require_seed(seed)
    console.require_out(out)


def settings(given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a command by name, without those on which no result depends."""
    return {key: value for key, value in given.items() if key not in ("threads", "share", "launch")}


def as_json(value: Any) -> Any:
    """Return an option as JSON can hold it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, tuple):
        return [as_json(each) for each in value]
    return str(value) if isinstance(value, pathlib.Path) else value


def recorded(settings: dict[str, Any], partial: resume.Partial) -> dict[str, Any]:
    """Return what `settings.json` records: the options, which step of each network was measured, and the sources."""
    return {key: as_json(value) for key, value in settings.items()} | {
        "networks": partial.networks,
        "files": partial.files,
        "code": partial.code,
    }


def finish(out: pathlib.Path, values: dict[str, Any], settings: dict[str, Any], partial: resume.Partial) -> None:
    """Write the metrics of an evaluation, delete what it kept in case of an interruption, and print the metrics."""
    from . import metrics

    metrics.write(out, values, settings=recorded(settings, partial))
    partial.finish()
    show(values)


def show(values: dict[str, Any]) -> None:
    """Print metrics, one on a line."""
    for name, value in values.items():
        console.say(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
