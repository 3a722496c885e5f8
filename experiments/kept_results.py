"""Results of complete evaluations, table by table, in one file of the repository.

An experiment of a day is done in pieces, on machines that do not keep their folders: what an evaluation found is kept
here, so that it need not be repeated, and so that a reader can compute every interval again.
"""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence
from typing import Any

from dipn_jax.eval.clearing.lockstep import Outcome

from dipn_jax.system import files
from experiments import runs
from experiments.runs import Run

COUNTS = ("objects", "removed", "held", "grasps", "pushes")
"""What is kept of each table, after its case and how it ended."""
ENDS = ("cleared", "pushed out", "out of actions", "fault")
"""How a table can end; kept as the number in this list."""


class Kept:
    """The file of kept results."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path
        self.found: dict[str, Any] = files.read_json(path) if path.exists() else {}

    def has(self, run: Run, key: str) -> bool:
        """Return whether the results of this command, with what it needs, are kept."""
        return bool(self.found.get(run.name, {}).get("key") == key)

    def keep(self, run: Run, key: str) -> None:
        """Keep the results of a run that is complete; of a run that clears no tables there are none."""
        path = run.out / "episodes.json"
        if "clear" not in run.command[:2] or not path.exists():
            return
        entries = files.read_json(path, wanted=list)
        cases = list(dict.fromkeys(entry["name"] for entry in entries))
        rows = [[cases.index(one["name"]), ENDS.index(one["ended"]), *(one[key] for key in COUNTS)] for one in entries]
        stamp = runs.read_stamp(run)
        made = {key: stamp[key] for key in ("command", "made_by", "seed", "versions")}
        settings = files.read_json(run.out / "settings.json")
        sources = {"networks": list(settings["networks"].values()), "code": settings["code"]}
        self.found = files.read_json(self.path) if self.path.exists() else {}  # others may have written
        self.found[run.name] = {"key": key, **made, **sources, "cases": cases, "rows": rows}
        _write(self.path, dict(sorted(self.found.items())))

    def tables(self, run: Run, key: str) -> list[Outcome] | None:
        """Return the tables of a run; None if they are not kept, or were made by another command."""
        if not self.has(run, key):
            return None
        found = self.found[run.name]
        return [Outcome(found["cases"][row[0]], ENDS[row[1]], *row[2:]) for row in found["rows"]]

    def made(self, listed: Sequence[Run]) -> dict[str, Any]:
        """Return how the kept runs among `listed` were made, as `pages.made` does."""
        facts = ("made_by", "seed", "versions")
        return {run.name: {key: self.found[run.name][key] for key in facts} for run in listed if run.name in self.found}


def missing(listed: Sequence[Run], only: Sequence[str], found: dict[str, str], kept: Kept) -> list[Run]:
    """Return the runs that have to be carried out: those whose results are not kept, and what these need.

    Args:
      listed: all runs.
      only: names of those wanted, as `runs.named` takes them; all if there are none.
      found: `runs.keys` of all.
      kept: the results that there are.
    """
    read = {other.name for run in listed for other in runs.needs(run, listed)}
    asked = runs.named(listed, only)
    ends = [run.name for run in runs.select(listed, asked) if run.name not in read or run.name in asked]
    left = [name for name in ends if not kept.has(next(run for run in listed if run.name == name), found[name])]
    return runs.select(listed, left) if left else []


def _write(path: pathlib.Path, found: dict[str, Any]) -> None:
    """Write the file with one line a run, so that two versions can be compared."""
    lines = [f"{json.dumps(name)}: {json.dumps(value, separators=(',', ':'))}" for name, value in found.items()]
    files.write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")
