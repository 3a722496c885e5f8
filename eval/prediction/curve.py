"""Error against number of pushes learnt from: the paper's figure, with a band over seeds."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np

from dipn_jax import files
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DIPN
from dipn_jax.storage import checkpoint

from .push_errors import DISTANCES

matplotlib.use("agg")
import matplotlib.pyplot as plt

MEASURES = (
    "push_error",
    "push_error_paper_measure",
    "push_error_segmented",
    "push_error_segmented_paper_measure",
    "push_position_mm",
    "push_angle_deg",
)


def load(runs: Sequence[pathlib.Path]) -> dict[str, DIPN]:
    """The networks of `dipn-train push` runs by `PUSHES/SEED`, in order.

    Raises:
      UserError: a folder holds no such run, one that has not ended, or two are of the same pushes and seed.
    """
    found: dict[tuple[int, int], DIPN] = {}
    for run in runs:
        network = checkpoint.load_network(run, network="dipn")
        meta = checkpoint.newest(run)[1]  # type: ignore[index]
        plan = run / "config.json"
        planned = files.read_json(plan).get("steps", 0) if plan.exists() else 0
        if planned > meta["step"]:
            raise UserError(f"--curve {run}: stopped at step {meta['step']} of {planned}; let its command end first")
        if "examples" not in meta:
            raise UserError(f"--curve {run}: its checkpoint does not say how many pushes it is of; train again")
        key = (int(meta["examples"]), int(meta["seed"]))
        if key in found:
            raise UserError(f"--curve {run}: a second run of {key[0]} pushes with seed {key[1]}; give one of each")
        found[key] = network  # type: ignore[assignment]
    return {f"{pushes}/{seed}": found[pushes, seed] for pushes, seed in sorted(found)}


def summary(values: dict[str, float], names: Sequence[str]) -> dict[str, float]:
    """`values` of networks `names` (`PUSHES/SEED`) as `MEASURE/curve/PUSHES/DISTANCE/WHICH/{mean,std,seeds}`.

    The standard deviation is that of a sample (n - 1), 0 where there is one seed.
    """
    result: dict[str, float] = {}
    sizes = sorted({int(name.split("/")[0]) for name in names})
    for measure in MEASURES:
        for pushes in sizes:
            seeds = [name for name in names if name.startswith(f"{pushes}/")]
            for at in (f"{c}cm/{which}" for c in DISTANCES for which in ("all", "moved")):
                each = [values[key] for name in seeds if (key := f"{measure}/{name}/{at}") in values]
                if each:
                    place = f"{measure}/curve/{pushes}/{at}"
                    result[f"{place}/mean"] = float(np.mean(each))
                    result[f"{place}/std"] = float(np.std(each, ddof=1)) if len(each) > 1 else 0.0
                    result[f"{place}/seeds"] = len(each)
    return result


def figure(values: dict[str, Any], *, which: str = "all") -> Any:
    """Curves of both error measures at both distances, baselines as lines, as a Matplotlib figure.

    Args:
      values: metrics with `summary`'s keys and the baselines'.
      which: all, or moved objects only.
    """
    made, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharex=True)
    titles = ("1 - IoU", "XOR / (2 true)")
    for axis, measure, title in zip(axes, MEASURES[:2], titles, strict=True):
        begin = f"{measure}/curve/"
        sizes = sorted({int(key[len(begin) :].split("/")[0]) for key in values if key.startswith(begin)})
        for centimetres, color in zip(DISTANCES, ("tab:blue", "tab:red"), strict=True):
            place = [f"{begin}{size}/{centimetres}cm/{which}" for size in sizes]
            mean = np.array([values[f"{p}/mean"] for p in place])
            std = np.array([values[f"{p}/std"] for p in place])
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


_SHOWN = (
    ("push_error", "1 - IoU", 3),
    ("push_error_paper_measure", "XOR / 2 true", 3),
    ("push_error_segmented", "1 - IoU, masks from the image", 3),
    ("push_position_mm", "mm", 2),
    ("push_angle_deg", "degrees", 2),
)


def table(values: dict[str, Any], *, which: str = "all") -> str:
    """The numbers of the figure, and more, as Markdown: mean and standard deviation over seeds.

    Args:
      values: metrics with `summary`'s keys and the baselines'.
      which: all, or moved objects only.
    """
    begin = "push_error/curve/"
    sizes = sorted({int(key[len(begin) :].split("/")[0]) for key in values if key.startswith(begin)})
    named = [(f"DIPN, {size:,} pushes", f"curve/{size}", "/mean") for size in sizes]
    named += [(f"`{name}`", name, "") for name in ("trans", "static", "physics")]
    shown = [(measure, title, digits, c) for measure, title, digits in _SHOWN for c in DISTANCES]
    shown = [row for row in shown if f"{row[0]}/trans/{row[3]}cm/{which}" in values]
    lines = ["| " + " | ".join(["predictor", *(f"{title}, {c} cm" for _, title, _, c in shown)]) + " |"]
    lines.append("| --- " * (len(shown) + 1) + "|")
    for label, place, end in named:
        cells = []
        for measure, _, digits, c in shown:
            key = f"{measure}/{place}/{c}cm/{which}"
            cell = f"{values[key + end]:.{digits}f}" if key + end in values else ""
            spread = f" ± {values[key + '/std']:.{digits}f}" if values.get(f"{key}/seeds", 0) > 1 else ""
            cells.append(cell + spread)
        if any(cells):
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
