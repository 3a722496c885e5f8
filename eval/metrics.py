"""Confidence intervals, and the flat `metrics.json` of every evaluation."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from dipn_jax import files

RESAMPLES = 2000
"""Number of bootstrap resamples."""


def ratio_interval(hits: np.ndarray, trials: np.ndarray, *, seed: int = 0) -> tuple[float, float, float]:
    """Return sum(hits) / sum(trials) over instances, with a bootstrap 95 % interval over instances.

    Args:
      hits: `[I]` per instance.
      trials: `[I]` per instance.
      seed: random seed of the resampling.

    Returns:
      Estimate, low, high; NaN where there is no trial.
    """
    hits, trials = np.asarray(hits, float), np.asarray(trials, float)
    if trials.sum() == 0:
        return float("nan"), float("nan"), float("nan")
    pick = np.random.default_rng(seed).integers(0, len(hits), (RESAMPLES, len(hits)))
    total = trials[pick].sum(-1)
    values = hits[pick].sum(-1)[total > 0] / total[total > 0]
    low, high = np.quantile(values, [0.025, 0.975])
    return float(hits.sum() / trials.sum()), float(low), float(high)


def write(out: pathlib.Path, values: dict[str, Any], *, settings: dict[str, Any]) -> None:
    """Write `metrics.json` (flat keys; null where there was nothing to count) and `settings.json` to `out`."""
    finite = {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in values.items()}
    files.write_json(out / "settings.json", {**settings, "versions": files.package_versions()})
    files.write_json(out / "metrics.json", finite)


def read(folder: pathlib.Path) -> dict[str, Any]:
    """Return the flat metrics of an evaluation.

    Raises:
      UserError: there are none.
    """
    return files.read_json(folder / "metrics.json")
