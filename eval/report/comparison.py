"""Methods side by side: tables beside the paper's, why tables were not cleared, and films of some of them."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from dipn_jax.commands import pages
from dipn_jax.errors import UserError

from .. import drawing
from ..clearing import film, lockstep
from .cleared import Cleared
from .results import NOTE, Results

FRAMES = 10
"""Number of pictures in a filmstrip."""
FILM_ROWS = 4
"""Number of steps in the figure of predictions."""
CAUSES = {
    "cleared": "cleared",
    "pushed out": "pushed out of the workspace",
    "thrown out": "thrown out by a grasp",
    "out of actions": "more than three actions an object",
    "fault": "the simulation went wrong",
}
"""How a table can end, and how the report says it."""


def flat(all_cleared: list[Cleared]) -> dict[str, Any]:
    """Return metrics for the report as `clear/TABLES/METHOD/...`, or `clear/TABLES/LABEL/METHOD/...` with a label.

    Raises:
      UserError: two folders are of the same tables, method and label.
    """
    values: dict[str, Any] = {}
    folders: dict[str, pathlib.Path] = {}
    for one in all_cleared:
        if one.key in folders:
            raise UserError(
                f"--clear {folders[one.key]} {one.folder}: both are {one.name} on {one.tables}; give one of them, or "
                "clear again with another --label"
            )
        folders[one.key] = one.folder
        values |= {f"{one.key}/{key}": value for key, value in one.values.items()}
    return values


def section(all_results: Sequence[Results]) -> tuple[str, dict[str, Any]]:
    """Return HTML with places for figures, and the figures by name."""
    parts, figures = ["<h2>Clearing tables</h2>"], {}
    for results in all_results:
        tables, rows = results.tables, results.rows
        notes = "".join(f"<p class=note>{pages.escaped(note)}</p>" for note in results.notes())
        numbers, causes = results_and_causes(rows, rival=results.rival)
        parts.append(f"<h3>{pages.escaped(tables)}</h3>{numbers}{notes}")
        parts.append(f"<p>Why tables were not cleared:</p>{causes}{{course-{tables}}}")
        figures[f"course-{tables}"] = _courses(rows)
        for number, one in enumerate(rows):
            place = f"clear-{tables}-{number}"
            figures[place] = _films(one)
            parts.append(
                f"<h4>{pages.escaped(one.name)} on {pages.escaped(tables)}: "
                f"the best, the median and the worst table</h4>{{{place}}}"
            )
    parts.append(
        f"<p class=note>{NOTE}</p><h2>What was seen, chosen, imagined, and what happened</h2>"
        "<p>Pushes first: the scene with the chosen action; the image predicted for the best push, with the values "
        "compared (gamma times the mean grasp score on it, and the mean score now); the scene after.</p>{steps}"
    )
    figures["steps"] = _steps([one for results in all_results for one in results.rows])
    return "".join(parts), figures


def results_and_causes(rows: Sequence[Cleared], *, rival: Cleared | None = None) -> tuple[str, str]:
    """Return the HTML tables of results on the same tables, beside the paper's, and of why some were not cleared.

    Args:
      rows: the results, at least one.
      rival: the one of them that the others are compared with.
    """
    return pages.table(*Results(rows, rival).cells()), _causes(rows)


def _cause(one: Cleared, entry: dict[str, Any]) -> str:
    """Return why a table ended, one of CAUSES: an object can leave the workspace at a push or at a grasp."""
    ended = str(entry["ended"])
    grasped = ended == "pushed out" and str(one.film(entry).what[-1]) != "push"
    return "thrown out" if grasped else ended


def _causes(rows: Sequence[Cleared]) -> str:
    """Return an HTML table of how tables ended, and on which cases they were not cleared."""
    lines = []
    for one in rows:
        causes = [_cause(one, entry) for entry in one.episodes]
        counts = [str(causes.count(cause)) for cause in CAUSES]
        failed = [entry["name"] for entry in one.episodes if entry["ended"] != "cleared"]
        where = ", ".join(f"{name} ({failed.count(name)})" for name in sorted(set(failed)))
        lines.append([one.name, *counts, where or "-"])
    return pages.table(["", *CAUSES.values(), "not cleared"], lines)


def share_left(one: Cleared, at: np.ndarray) -> np.ndarray:
    """Return the share of objects left after `at [A]` actions per object, averaged over tables: `[A]`."""
    shares = []
    for entry in one.episodes:
        left = (one.film(entry).shape >= 0).sum(1) / entry["objects"]
        shares.append(np.interp(at * entry["objects"], np.arange(len(left)), left))
    return np.mean(shares, axis=0)


def _courses(rows: Sequence[Cleared]) -> Any:
    """Plot the share of objects left against the number of actions."""
    figure, axis = plt.subplots(figsize=(6, 3.5))
    at = np.linspace(0, lockstep.ACTIONS_PER_OBJECT, 61)
    for one in rows:
        axis.plot(at, 100 * share_left(one, at), label=drawing.label(one.name))
    axis.plot(at, 100 * np.maximum(1 - at, 0), color="0.7", lw=1, ls=":", label="an object an action")
    axis.set(xlabel="actions an object", ylabel="objects left, %", ylim=(0, 102))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7)
    return figure


def _films(one: Cleared) -> Any:
    """Draw filmstrips of the best, median and worst table, by objects per action."""

    def quality(entry: dict[str, Any]) -> tuple[bool, float]:
        return entry["ended"] == "cleared", entry["removed"] / max(entry["grasps"] + entry["pushes"], 1)

    ranked = sorted(one.episodes, key=quality, reverse=True)
    chosen = [ranked[0], ranked[len(ranked) // 2], ranked[-1]]
    figure, axes = plt.subplots(3, FRAMES, figsize=(1.5 * FRAMES, 5.4), squeeze=False)
    for row, (which, entry) in enumerate(zip(("best", "median", "worst"), chosen, strict=True)):
        reel = one.film(entry)
        steps = np.unique(np.linspace(0, len(reel.what) - 1, FRAMES).round().astype(int))
        for axis in axes[row]:
            axis.axis("off")
        for axis, i in zip(axes[row], steps, strict=False):
            axis.axis("on")
            drawing.show(axis, reel.before(i), f"{i + 1}: {reel.what[i]}")
            _draw(axis, reel, i)
        axes[row, 0].set_ylabel(drawing.label(f"{which}: {entry['name']}\n{entry['ended']}"), fontsize=8)
    figure.tight_layout(pad=0.4)
    return figure


def _draw(axis: Any, reel: film.Film, step: int) -> None:
    if reel.what[step] == "push":
        drawing.arrow(axis, reel.push[step])
    else:
        drawing.jaws(axis, reel.grasp[step])


def _steps(all_cleared: list[Cleared]) -> Any:
    """Draw some steps with what was predicted, pushes first; methods that imagine images come first."""
    steps = []
    for one in sorted(all_cleared, key=lambda one: one.method != "dipn+gn"):
        for entry in one.episodes:
            reel = one.film(entry)
            steps += [(entry["name"], i, reel) for i in range(len(reel.what))]
    steps.sort(key=lambda step: (str(step[2].what[step[1]]) != "push", step[1]))
    chosen = steps[:FILM_ROWS]
    figure, axes = plt.subplots(len(chosen), 3, figsize=(7.5, 2.7 * len(chosen)), squeeze=False)
    for row, (name, i, reel) in enumerate(chosen):
        before, predicted, after = reel.pictures(i)
        score, now, push = reel.values[i]
        drawing.show(axes[row, 0], before, f"{name}, action {i + 1}: {reel.what[i]}")
        _draw(axes[row, 0], reel, i)
        if reel.what[i] == "push":
            title = f"predicted: {push:.4f} > {now:.4f}"
        else:
            considered = np.isfinite(push)
            title = (
                f"best push, not taken: {push:.4f} < {now:.4f}" if considered else f"no push; grasp score {score:.2f}"
            )
        drawing.show(axes[row, 1], predicted, title)
        drawing.show(axes[row, 2], after, "what happened")
    return figure
