"""Grasp success against grasps learnt from: the paper's figure, with and without pre-training, a band over seeds."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np

from dipn_jax import files
from dipn_jax.errors import UserError

matplotlib.use("agg")
import matplotlib.pyplot as plt

GROUPS = {"with": "with pre-training", "without": "without pre-training"}


def load(runs: Sequence[pathlib.Path]) -> dict[str, dict[int, list[float]]]:
    """Success over the last grasps, by whether the network was pre-trained and after how many grasps: one a seed.

    Raises:
      UserError: a folder is no run of `dipn-train grasp-online`.
    """
    found: dict[str, dict[int, list[float]]] = {}
    for run in runs:
        config = files.read_json(run / "config.json")
        if "pretrained" not in config:
            raise UserError(f"--curve {run}: no run of dipn-train grasp-online")
        try:
            lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        except (OSError, json.JSONDecodeError):
            raise UserError(f"--curve {run}: no readable metrics.jsonl; train again") from None
        group = found.setdefault("with" if config["pretrained"] else "without", {})
        for line in lines:
            group.setdefault(int(line["step"]), []).append(float(line["success"]))
    return found


def summary(found: dict[str, dict[int, list[float]]]) -> dict[str, float]:
    """`online/{with,without}/GRASPS/{mean,std,seeds}`; the standard deviation is that of a sample, 0 for one seed."""
    result: dict[str, float] = {}
    for name, group in found.items():
        for grasps, each in sorted(group.items()):
            at = f"online/{name}/{grasps}"
            std = float(np.std(each, ddof=1)) if len(each) > 1 else 0.0
            result |= {f"{at}/mean": float(np.mean(each)), f"{at}/std": std, f"{at}/seeds": len(each)}
    return result


def figure(values: dict[str, Any]) -> Any:
    """The curves as a matplotlib figure."""
    drawn, axis = plt.subplots(figsize=(6, 4))
    for name, title in GROUPS.items():
        counts = sorted(
            int(key.split("/")[2]) for key in values if key.startswith(f"online/{name}/") and key.endswith("/mean")
        )
        if not counts:
            continue
        mean, std = (np.array([values[f"online/{name}/{n}/{key}"] for n in counts]) for key in ("mean", "std"))
        seeds = int(values[f"online/{name}/{counts[-1]}/seeds"])
        axis.plot(counts, mean, label=f"{title}, {seeds} seeds")
        axis.fill_between(counts, mean - std, np.minimum(mean + std, 1.0), alpha=0.2)
    axis.axhline(0.9, color="grey", lw=0.8)
    axis.set(xlabel="grasps", ylabel="success of the last 50 grasps", ylim=(0, 1.02))
    axis.legend()
    axis.grid(alpha=0.3)
    return drawn


def table(values: dict[str, Any], counts: Sequence[int]) -> str:
    """Success after so many grasps, as Markdown."""
    lines = ["| | " + " | ".join(f"{n} grasps" for n in counts) + " |", "| --- " * (len(counts) + 1) + "|"]
    for name, title in GROUPS.items():
        cells = []
        for n in counts:
            at = f"online/{name}/{n}"
            cells.append(f"{values[at + '/mean']:.3f} ± {values[at + '/std']:.3f}" if f"{at}/mean" in values else "")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
