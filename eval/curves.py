"""Learning curves with a band over seeds: prediction error against pushes, grasp success against grasps."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np

from dipn_jax.commands import markdown
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DIPN
from dipn_jax.storage import checkpoint
from dipn_jax.system import files, typed

from .prediction.push_errors import DISTANCES

matplotlib.use("agg")
import matplotlib.pyplot as plt

PUSH_MEASURES = (
    "push_error",
    "push_error_paper_measure",
    "push_error_segmented",
    "push_error_segmented_paper_measure",
    "push_position_mm",
    "push_angle_deg",
)
"""Measures of `push_errors` for each network; the figure shows the first two."""
_PUSH_COLUMNS = (
    ("push_error", "1 - IoU", 3),
    ("push_error_paper_measure", "XOR / 2 true", 3),
    ("push_error_segmented", "1 - IoU, masks from the image", 3),
    ("push_position_mm", "mm", 2),
    ("push_angle_deg", "degrees", 2),
)
"""Measure, title and decimals of each column of the table of pushes."""
GRASP_GROUPS = {"with": "with pre-training", "without": "without pre-training"}
"""Keys and titles of the two curves of grasps."""


def load_push_runs(runs: Sequence[pathlib.Path]) -> dict[str, DIPN]:
    """Load the networks of `dipn-train push` runs by `PUSHES/SEED`, in order.

    Raises:
      UserError: a folder holds no such run, one that has not ended, or two are of the same pushes and seed.
    """
    found: dict[tuple[int, int], DIPN] = {}
    for run in runs:
        network = checkpoint.load_network(run, network="dipn")
        meta = checkpoint.newest(run)[1]  # type: ignore[index]
        plan = run / "config.json"
        planned = files.read_json(plan, wanted={"steps?": int}).get("steps", 0) if plan.exists() else 0
        if planned > meta["step"]:
            raise UserError(f"--curve {run}: stopped at step {meta['step']} of {planned}; run its command to the end")
        try:
            typed.check(meta, {"examples": typed.Whole(), "seed": int})
        except typed.Misfit:
            raise UserError(f"--curve {run}: its checkpoint does not name its number of pushes; train again") from None
        key = (meta["examples"], meta["seed"])
        if key in found:
            raise UserError(f"--curve {run}: a second run of {key[0]} pushes with seed {key[1]}; give one of each")
        found[key] = network  # type: ignore[assignment]
    return {f"{pushes}/{seed}": found[pushes, seed] for pushes, seed in sorted(found)}


def load_grasp_runs(runs: Sequence[pathlib.Path]) -> dict[str, dict[int, list[float]]]:
    """Read the success over the last grasps of `dipn-train grasp-online` runs, one value per seed.

    Returns:
      Success by key of GRASP_GROUPS and number of grasps.

    Raises:
      UserError: a folder is no run of `dipn-train grasp-online`.
    """
    found: dict[str, dict[int, list[float]]] = {}
    for run in runs:
        if run.is_file():
            raise UserError(f"--curve {run}: a file, not the folder of a run of dipn-train grasp-online")
        config = files.read_json(run / "config.json")
        if "pretrained" not in config:
            raise UserError(f"--curve {run}: no run of dipn-train grasp-online")
        lines = files.read_lines(run / "metrics.jsonl", wanted={"step": typed.Whole(), "success": float})
        group = found.setdefault("with" if config["pretrained"] else "without", {})
        for line in lines:
            group.setdefault(int(line["step"]), []).append(float(line["success"]))
    return found


def push_summary(values: dict[str, float], names: Sequence[str]) -> dict[str, float]:
    """Summarize networks called `PUSHES/SEED` as `MEASURE/curve/PUSHES/DISTANCE/WHICH/{mean,std,seeds}`."""
    result: dict[str, float] = {}
    for measure in PUSH_MEASURES:
        for pushes in sorted({int(name.split("/")[0]) for name in names}):
            seeds = [name for name in names if name.startswith(f"{pushes}/")]
            for at in (f"{c}cm/{which}" for c in DISTANCES for which in ("all", "moved")):
                each = [values[key] for name in seeds if (key := f"{measure}/{name}/{at}") in values]
                if each:
                    result |= _band(f"{measure}/curve/{pushes}/{at}", each)
    return result


def grasp_summary(found: dict[str, dict[int, list[float]]]) -> dict[str, float]:
    """Summarize what `load_grasp_runs` found as `online/{with,without}/GRASPS/{mean,std,seeds}`."""
    result: dict[str, float] = {}
    for name, group in found.items():
        for grasps, each in sorted(group.items()):
            result |= _band(f"online/{name}/{grasps}", each)
    return result


def _band(place: str, each: Sequence[float]) -> dict[str, float]:
    """Return mean, standard deviation (of a sample, n - 1; 0 for one seed) and number of values."""
    std = float(np.std(each, ddof=1)) if len(each) > 1 else 0.0
    return {f"{place}/mean": float(np.mean(each)), f"{place}/std": std, f"{place}/seeds": len(each)}


def _counts(values: dict[str, Any], begin: str) -> list[int]:
    """Return the numbers of pushes or grasps that follow `begin` in the names of metrics, in order."""
    return sorted({int(key[len(begin) :].split("/")[0]) for key in values if key.startswith(begin)})


def _means(values: dict[str, Any], places: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation at each of `places`."""
    return tuple(np.array([values[f"{place}/{key}"] for place in places]) for key in ("mean", "std"))  # type: ignore[return-value]


def push_figure(values: dict[str, Any], *, which: str = "all") -> Any:
    """Plot two error measures at both distances, baselines as lines, as a Matplotlib figure.

    Args:
      values: metrics with `push_summary`'s keys and the baselines'.
      which: all, or moved objects only.
    """
    made, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharex=True)
    titles = ("1 - IoU", "XOR / (2 true)")
    for axis, measure, title in zip(axes, PUSH_MEASURES[:2], titles, strict=True):
        begin = f"{measure}/curve/"
        sizes = _counts(values, begin)
        for centimetres, color in zip(DISTANCES, ("tab:blue", "tab:red"), strict=True):
            mean, std = _means(values, [f"{begin}{size}/{centimetres}cm/{which}" for size in sizes])
            axis.plot(sizes, mean, "o-", color=color, ms=3, label=f"DIPN, {centimetres} cm")
            axis.fill_between(sizes, mean - std, mean + std, color=color, alpha=0.2, lw=0)
            for name, style in (("trans", "--"), ("static", ":"), ("physics", "-.")):
                level = values.get(f"{measure}/{name}/{centimetres}cm/{which}")
                if level is not None:
                    axis.axhline(level, color=color, ls=style, lw=0.9, label=f"{name}, {centimetres} cm")
        axis.set(xscale="log", xlabel="pushes", ylabel=f"{title}, {which} objects", ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7, ncol=2)
    made.tight_layout()
    return made


def grasp_figure(values: dict[str, Any]) -> Any:
    """Plot success against grasps, with and without pre-training, as a Matplotlib figure."""
    made, axis = plt.subplots(figsize=(6, 4))
    for name, title in GRASP_GROUPS.items():
        counts = _counts(values, f"online/{name}/")
        if not counts:
            continue
        mean, std = _means(values, [f"online/{name}/{n}" for n in counts])
        seeds = int(values[f"online/{name}/{counts[-1]}/seeds"])
        axis.plot(counts, mean, label=f"{title}, {seeds} seeds")
        axis.fill_between(counts, mean - std, np.minimum(mean + std, 1.0), alpha=0.2)
    axis.axhline(0.9, color="grey", lw=0.8)
    axis.set(xlabel="grasps", ylabel="success of the last 50 grasps", ylim=(0, 1.02))
    axis.legend()
    axis.grid(alpha=0.3)
    return made


def push_table(values: dict[str, Any], *, which: str = "all") -> str:
    """Return the numbers of the figure, and more, as Markdown: mean and standard deviation over seeds.

    Args:
      values: metrics with `push_summary`'s keys and the baselines'.
      which: all, or moved objects only.
    """
    sizes = _counts(values, "push_error/curve/")
    named = [(f"DIPN, {size:,} pushes", f"curve/{size}", "/mean") for size in sizes]
    named += [(f"`{name}`", name, "") for name in ("trans", "static", "physics")]
    columns = [(measure, title, digits, c) for measure, title, digits in _PUSH_COLUMNS for c in DISTANCES]
    columns = [row for row in columns if f"{row[0]}/trans/{row[3]}cm/{which}" in values]
    rows = [["predictor", *(f"{title}, {c} cm" for _, title, _, c in columns)]]
    for label, place, end in named:
        cells = []
        for measure, _, digits, c in columns:
            key = f"{measure}/{place}/{c}cm/{which}"
            cell = f"{values[key + end]:.{digits}f}" if key + end in values else ""
            spread = f" ± {values[key + '/std']:.{digits}f}" if values.get(f"{key}/seeds", 0) > 1 else ""
            cells.append(cell + spread)
        if any(cells):
            rows.append([label, *cells])
    return markdown.table(rows[0], rows[1:])


def grasp_table(values: dict[str, Any], counts: Sequence[int]) -> str:
    """Return the success after each of `counts` grasps as Markdown."""
    rows = [["", *(f"{n} grasps" for n in counts)]]
    for name, title in GRASP_GROUPS.items():
        cells = []
        for n in counts:
            at = f"online/{name}/{n}"
            cells.append(f"{values[at + '/mean']:.3f} ± {values[at + '/std']:.3f}" if f"{at}/mean" in values else "")
        rows.append([title, *cells])
    return markdown.table(rows[0], rows[1:])
