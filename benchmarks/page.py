"""`python -m benchmarks.page FILE.json ...`: figures and their origins as the tables of docs/benchmarks.md."""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from benchmarks import on_gpu
from benchmarks.__main__ import BENCHMARKS
from benchmarks.harness import Figures
from dipn_jax.commands import console, markdown
from dipn_jax.system import files

SETTINGS = "datagen_mjx.settings"
"""The benchmark of other settings of MJX."""
COLUMNS = ("time", "p50_mm", "p90_mm", "grasps_equal", "faults")
"""Columns of its table."""


def tables(figures: Figures) -> str:
    """Return as Markdown ratios with their goals, episodes per second, and the cost of other settings of MJX."""
    goals = {known: benchmark.goal for known, benchmark in BENCHMARKS.items()}
    goals |= {known: stage.goal for known, stage in on_gpu.STAGES.items()}
    ratios = []
    rates: dict[str, dict[int, float]] = {}
    variants: dict[str, dict[str, float]] = {}
    for name, value in figures.items():
        base = next(known for known in goals if name == known or name.startswith((f"{known}/", f"{known}.")))
        if base == SETTINGS:
            _, variant, key = name.split("/")
            variants.setdefault(variant, {})[key] = value
        elif base.startswith("rates."):
            kind, _, count = name.removeprefix("rates.").rpartition("/")
            rates.setdefault(kind.replace("/", ", "), {})[int(count)] = value
        else:
            plain = name == base or name.rpartition("/")[2].isdigit()
            ratios.append([f"`{name}`", goals[base] if plain else "", f"{value:.3g}"])
    counts = sorted({count for row in rates.values() for count in row})
    speeds = [[kind, *(f"{row[count]:.3g}" if count in row else "" for count in counts)] for kind, row in rates.items()]
    others = [
        [f"`{variant}`", *(f"{found[key]:.3g}" if key in found else "" for key in COLUMNS)]
        for variant, found in variants.items()
    ]
    heads = (["figure", "goal", "value"], ["episodes a second", *map(str, counts)], ["MJX with", *COLUMNS])
    shown = zip(heads, (ratios, speeds, others), strict=True)
    return "\n".join(markdown.table(head, rows) for head, rows in shown if rows)


OTHERS = ("torch", "pybullet")
"""Packages that only some rows need, whose versions a machine has as keys of its own."""


def origins(kept: dict[str, Any]) -> str:
    """Machines, commits, versions and seeds behind the figures of a file, as a Markdown table with a row for each.

    Args:
      kept: what a file of `--out` holds, or several merged by hand, where `machine` is a list and says its `rows`.
    """
    machines = kept["machine"] if isinstance(kept["machine"], list) else [kept["machine"]]
    titles = ["figures", "machine", "commit", "versions", "scale", "seed"]
    rows = []
    for facts in machines:
        place = [facts["processor"], f"{facts['cores']} core{'s' * (facts['cores'] > 1)}"]
        place += [device for device in facts["devices"] if device != "cpu"]
        shown = {name: facts["versions"].get(name) for name in ("jax", "mujoco", "warp-lang")}
        shown |= {name: facts.get(name) for name in OTHERS}
        versions = [f"python {facts['python']}", *(f"{name} {found}" for name, found in shown.items() if found)]
        cells = [facts.get("rows", "all"), ", ".join(place), facts["commit"], ", ".join(versions)]
        rows.append([*cells, facts["scale"], str(facts["seed"])])
    return markdown.table(titles, rows)


def merged(paths: Sequence[pathlib.Path]) -> Figures:
    """Return the figures of several files of `--out`; of one measured twice, the later file's."""
    figures: Figures = {}
    for path in paths:
        figures.update(files.read_json(path)["figures"])
    return figures


if __name__ == "__main__":
    given = [pathlib.Path(name) for name in sys.argv[1:]]
    console.say("\n".join([tables(merged(given)), *(origins(files.read_json(path)) for path in given)]))
