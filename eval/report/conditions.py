"""Which tables were cleared and what was seen of them, compared between the rows of a table of results."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from dipn_jax.system import typed
from dipn_jax.world.ranges import DEFAULT_RANGES

from ..clearing.camera import DEFAULT_CAMERA
from ..clearing.tables import DEFAULT_TABLES

NOT_RECORDED = "not recorded"
"""What is said of an option that `settings.json` lacks."""
CASE_FILE = "case file"
"""Name of the digest of a case file among the options."""
DIGITS = 12
"""Digits of a digest that are compared and shown."""
FORM = {
    "tables.names?": [str],
    "tables.instances?": typed.Whole(1),
    "tables.as_placed?": bool,
    "tables.ranges?": dict,
    "seed?": typed.Whole(),
    "camera.masks?": str,
    "camera.height_noise?": float,
    "camera.holes?": float,
    "camera.image_noise?": float,
    "engine?": str,
    "files?": {str: str},
}
"""Form of what is read of `settings.json`, beside `tables.cases` and `tables.objects`."""


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What an evaluation records of its tables and of what was seen of them: values as text, by option."""

    tables: dict[str, str]  # what decides which tables were cleared
    seen: dict[str, str]  # what else was seen or simulated

    def same_tables(self, other: Conditions) -> bool:
        """Return whether another evaluation is known to be of the same tables, in the same order."""
        return self.tables == other.tables and NOT_RECORDED not in self.tables.values()


def read(settings: Mapping[str, Any]) -> Conditions:
    """Return the conditions that `settings.json` records: options on which the tables do not depend are left out."""
    seed, engine = {"--seed": _text(settings.get("seed"))}, {"--engine": _text(settings.get("engine"))}
    count = {"--instances": _text(settings.get("tables.instances"))}
    if settings["tables.cases"] == "random":
        ranges = settings.get("tables.ranges", {})
        tables = {"--objects": _text(settings["tables.objects"])} | count | seed
        tables |= {_option(name): _text(ranges.get(name)) for name in dataclasses.asdict(DEFAULT_RANGES)} | engine
    else:
        digests = [digest[:DIGITS] for digest in settings.get("files", {}).values()]
        tables = {CASE_FILE: " ".join(digests) or NOT_RECORDED}
        tables |= {_option(name): _text(settings.get(f"tables.{name}")) for name in ("names", "as_placed")}
        tables |= count | seed
    seen = {_option(name): _text(settings.get(f"camera.{name}")) for name in dataclasses.asdict(DEFAULT_CAMERA)}
    return Conditions(tables, seen if engine.items() <= tables.items() else seen | engine)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _text(value: Any) -> str:
    """Return the value of an option as a report shows it."""
    if value is None:
        return NOT_RECORDED
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " ".join(map(_text, value)) or "all"
    return f"{value:g}" if isinstance(value, float) else typed.brief(value)


_QUIET = {
    _option(name): _text(value)
    for name, value in (
        dataclasses.asdict(DEFAULT_RANGES)
        | {name: getattr(DEFAULT_TABLES, name) for name in ("names", "as_placed")}
        | {name: getattr(DEFAULT_CAMERA, name) for name in ("height_noise", "holes", "image_noise")}
    ).items()
}
"""Options that are not mentioned where all rows have this value, the default."""


def notes(rows: Mapping[str, Conditions]) -> list[str]:
    """Return sentences that say with which options the rows of a table were made, and in which they differ.

    Args:
      rows: the conditions of each row, by its name.
    """
    shared: dict[str, str] = {}
    differ: list[str] = []
    for kind, begin in (("tables", "Rows of different tables"), ("seen", "Seen or simulated differently")):
        parts = {name: getattr(row, kind) for name, row in rows.items()}
        found: list[str] = []
        for option in dict.fromkeys(option for part in parts.values() for option in part):
            values = {name: part.get(option, NOT_RECORDED) for name, part in parts.items()}
            if len(set(values.values())) > 1:
                found.append(f"{option} {_by_value(values)}")
            else:
                shared[option] = next(iter(values.values()))
        differ += [f"{begin}: {'; '.join(found)}."] if found else []
    told = [
        f"{option} {value}"
        for option, value in shared.items()
        if option != CASE_FILE and value not in (_QUIET.get(option), NOT_RECORDED)
    ]
    return [*([f"All rows: {', '.join(told)}."] if told else []), *differ]


def _by_value(values: Mapping[str, str]) -> str:
    """Return the values of an option, each with the names of the rows that have it."""
    having: dict[str, list[str]] = {}
    for name, value in values.items():
        having.setdefault(value, []).append(name)
    return ", ".join(f"{value} ({', '.join(names)})" for value, names in having.items())
