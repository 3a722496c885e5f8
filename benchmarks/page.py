"""`python -m benchmarks.page FILE.json ...`: figures and their origins as the tables of docs/benchmarks.md."""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Collection, Sequence
from typing import Any

from benchmarks import on_gpu
from benchmarks.__main__ import BENCHMARKS
from benchmarks.harness import Figures
from dipn_jax.commands import console, markdown
from dipn_jax.system import files

SETTINGS_BENCHMARK = "datagen_mjx.settings"
"""The benchmark of other settings of MJX."""
COLUMNS = ("time", "p50_mm", "p90_mm", "grasps_equal", "faults")
"""Columns of the table of SETTINGS_BENCHMARK."""


def _goals() -> dict[str, str]:
    """Return the goals of all benchmarks and stages, by name."""
    goals = {known: benchmark.goal for known, benchmark in BENCHMARKS.items()}
    return goals | {known: stage.goal for known, stage in on_gpu.STAGES.items()}


def _base(name: str, goals: dict[str, str]) -> str:
    """Return the benchmark or stage that a figure is of."""
    return next(known for known in goals if name == known or name.startswith((f"{known}/", f"{known}.")))


def _has_goal(name: str, base: str) -> bool:
    """Return whether a goal of benchmark `base` is about a figure: the only one, that of a count, or of a preset."""
    of = name.removeprefix(f"{base}/")
    return name == base or of.isdigit() or of in ("compact", "paper")


def headline(figures: Figures, known: Collection[str]) -> str:
    """Return in sentences how many figures reach their goals, which miss them, and what is not measured.

    Args:
      figures: value by name.
      known: names of the benchmarks or stages that could be measured.
    """
    goals, reached, missed = _goals(), 0, []
    for name, value in figures.items():
        base = _base(name, goals)
        compare, _, bound = goals[base].partition(" ")
        if _has_goal(name, base) and compare in (">=", "<="):
            if value >= float(bound) if compare == ">=" else value <= float(bound):
                reached += 1
            else:
                missed.append(f"`{name}` ({value:.3g}, goal {goals[base]})")
    there = {_base(name, goals) for name in figures}
    others = [f"`{name}`" for name in known if goals[name] != "none" and name not in there]
    return (
        f"{reached} of {reached + len(missed)} figures with a goal reach it. Missed: {', '.join(missed) or 'none'}. "
        f"Not measured: {', '.join(others) or 'none'}."
    )


def tables(figures: Figures) -> str:
    """Return as Markdown ratios with their goals, episodes per second, and the cost of other settings of MJX."""
    goals, ratios = _goals(), []
    rates: dict[str, dict[int, float]] = {}
    variants: dict[str, dict[str, float]] = {}
    for name, value in figures.items():
        base = _base(name, goals)
        if base == SETTINGS_BENCHMARK:
            _, variant, key = name.split("/")
            variants.setdefault(variant, {})[key] = value
        elif base.startswith("rates."):
            kind, _, count = name.removeprefix("rates.").rpartition("/")
            rates.setdefault(kind.replace("/", ", "), {})[int(count)] = value
        else:
            ratios.append([f"`{name}`", goals[base] if _has_goal(name, base) else "", f"{value:.3g}"])
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
    """Return the machines, commits, versions and seeds behind the figures of a file, as a Markdown table, a row each.

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
    machines = [origins(files.read_json(path)) for path in given]
    console.say("\n".join([headline(merged(given), BENCHMARKS), "", tables(merged(given)), *machines]))
