"""What the commands of `dipn-eval` share: options that make sense, results that are written."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

from dipn_jax import console
from dipn_jax.storage import resume

from . import metrics


def check(out: pathlib.Path, seed: int, **counts: int) -> None:
    """Refuse counts that are not positive, a seed that is none, an `out` that cannot be a folder."""
    console.require_positive(**counts)
    console.require_seed(seed)
    console.require_out(out)


def plain(value: Any) -> Any:
    """An option as JSON can hold it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, tuple):
        return [plain(each) for each in value]
    return str(value) if isinstance(value, pathlib.Path) else value


def finish(out: pathlib.Path, values: dict[str, Any], settings: dict[str, Any], partial: resume.Partial) -> None:
    """Write the metrics of an evaluation, drop what it kept for going on, and say them."""
    metrics.write(out, values, settings={key: plain(value) for key, value in settings.items()})
    partial.finish()
    for name, value in values.items():
        console.say(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
