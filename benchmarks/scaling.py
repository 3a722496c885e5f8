"""`python -m benchmarks.scaling FILE.json`: what large data sets cost, as the tables of docs/scaling.md."""

from __future__ import annotations

import pathlib
import sys
from typing import Any

from benchmarks.page import origins
from dipn_jax.commands import console, markdown
from dipn_jax.system import files

MILLION = 1_000_000
"""Episodes that a cost is given for."""
SHARD = 500
"""Episodes of a shard, the default of the commands."""
COLUMNS = {
    "milliseconds": "ms a shard",
    "again_milliseconds": "ms a shard, asked again",
    "megabytes_more": "MB more in the driver",
    "manifest_bytes": "bytes a shard in the list",
}
"""Figures of `jobs.overhead` and their titles."""


def costs(kept: dict[str, Any]) -> str:
    """Return the table of what a million episodes cost by kind and number of objects.

    On more cores it is as many times quicker, as long as there are shards for all: they share nothing. `kept` is a file
    of `python -m benchmarks --out`, or several of one machine merged by hand, as `page.origins` takes them.
    """
    machines = kept["machine"] if isinstance(kept["machine"], list) else [kept["machine"]]
    cores, rows = machines[0]["cores"], []
    for name, rate in kept["figures"].items():
        if name.startswith("rates.native/"):
            _, kind, objects = name.split("/")
            hours = MILLION / rate / 3600 * cores
            cells = [f"{rate:.3g}", f"{hours:.3g}", f"{hours / 100:.2g} h", f"{SHARD * cores / rate:.2g} s"]
            rows.append([kind, objects, *cells, f"{10_000 * rate / cores / SHARD:.3g}"])
    head = ["kind", "objects", f"episodes a second, {cores} cores", "core-hours a million"]
    return markdown.table([*head, "a million on 100 cores", "a shard on one", "shards a second on 10,000"], rows)


def overheads(kept: dict[str, Any]) -> str:
    """Return the table of what a shard costs besides physics, by launcher and number of shards."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in kept["figures"].items():
        if name.startswith("jobs.overhead/") and name.count("/") == 3:
            _, launcher, count, key = name.split("/")
            found.setdefault((launcher, count), {})[key] = value
    rows = [
        [launcher, f"{int(count):,}", *(f"{row[key]:.3g}" for key in COLUMNS)]
        for (launcher, count), row in found.items()
    ]
    return markdown.table(["launcher", "shards", *COLUMNS.values()], rows)


if __name__ == "__main__":
    kept = files.read_json(pathlib.Path(sys.argv[1]))
    console.say("\n".join([costs(kept), overheads(kept), origins(kept)]))
