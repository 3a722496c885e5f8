"""The page of what runs survive: `docs/reliability.md` and its JSON."""

from __future__ import annotations

import pathlib
from typing import Any

from dipn_jax import files
from experiments import pages


def write(key: str, found: dict[str, Any], *, docs: pathlib.Path = pages.DOCS) -> None:
    """Put what an experiment found into `reliability.json` under its key."""
    path = docs / "reliability.json"
    values = files.read_json(path) if path.exists() else {}
    files.write_json(path, values | {key: found})
