"""Confidence intervals, and the flat `metrics.json` of every evaluation."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import special

from dipn_jax.system import files

RESAMPLES = 2000
"""Number of bootstrap resamples."""
TAIL = 0.025
"""Share of resamples that is outside of an interval on each side, where groups are many."""


def ratio_interval(
    hits: np.ndarray, trials: np.ndarray, *, groups: Sequence[Any] | None = None, seed: int = 0
) -> tuple[float, float, float]:
    """Return sum(hits) / sum(trials) over tables, with a bootstrap 95 % interval.

    Few groups vary less in their resamples than they do, so the interval ends at more extreme resamples the fewer they
    are (`_tail`). Where all trials hit, or none, resamples do not vary: then it is the binomial interval of as many
    trials as there are groups, or tables of the only group (Clopper and Pearson, Biometrika 26, 1934).

    Args:
      hits: `[I]` per table.
      trials: `[I]` per table.
      groups: `[I]` what each table is a repeat of, such as its case: groups are drawn with replacement, and then the
        tables of each (a two-stage bootstrap: Davison and Hinkley, Bootstrap Methods, 1997, 3.8). None: every table is
        a group of its own.
      seed: random seed of the resampling.

    Returns:
      Estimate, low, high; NaN where there is no trial.
    """
    hits, trials = np.asarray(hits, float), np.asarray(trials, float)
    if trials.sum() == 0:
        return float("nan"), float("nan"), float("nan")
    value, number = float(hits.sum() / trials.sum()), _groups(trials, groups)
    if not hits.any():
        return value, 0.0, 1 - TAIL ** (1 / number)
    if (hits == trials).all():
        return value, TAIL ** (1 / number), 1.0
    pick = _resamples(len(hits), groups, seed)
    total = _total(trials, pick)
    values = _total(hits, pick)[total > 0] / total[total > 0]
    return value, *_ends(values, number)


def ratio_difference(
    ours: tuple[np.ndarray, np.ndarray], theirs: tuple[np.ndarray, np.ndarray], groups: Sequence[Any], *, seed: int = 0
) -> tuple[float, float, float]:
    """Return how much larger our ratio is than theirs on the same tables, with a paired bootstrap 95 % interval.

    Args:
      ours: hits and trials, `[I]` each.
      theirs: hits and trials of the other method on the same tables, in the same order.
      groups: `[I]` as of `ratio_interval`.
      seed: random seed of the resampling.

    Returns:
      Difference, low, high; NaN where one of the two has no trial.
    """
    (hits, trials), (others, tried) = (tuple(np.asarray(part, float) for part in side) for side in (ours, theirs))
    if trials.sum() == 0 or tried.sum() == 0:
        return float("nan"), float("nan"), float("nan")
    pick = _resamples(len(hits), groups, seed)
    both = (_total(trials, pick) > 0) & (_total(tried, pick) > 0)
    values = (_total(hits, pick)[both] / _total(trials, pick)[both]) - (
        _total(others, pick)[both] / _total(tried, pick)[both]
    )
    difference = float(hits.sum() / trials.sum() - others.sum() / tried.sum())
    return difference, *_ends(values, _groups(trials + tried, groups))


def _groups(trials: np.ndarray, groups: Sequence[Any] | None) -> int:
    """Return the number of groups that have a trial; of one group, the number of its tables with a trial."""
    tables = np.flatnonzero(trials)
    if groups is None:
        return len(tables)
    number = len(np.unique(np.asarray(groups)[tables]))
    return number if number > 1 else len(tables)


def _ends(values: np.ndarray, groups: int) -> tuple[float, float]:
    """Return the ends of the interval of what the resamples gave."""
    low, high = np.quantile(values, [_tail(groups), 1 - _tail(groups)])
    return float(low), float(high)


def _tail(groups: int) -> float:
    """Return the share of resamples that is left out on each side.

    Source: the expanded percentile interval of Hesterberg, What Teachers Should Know About the Bootstrap, The American
    Statistician 69, 2015, 4.5: for a mean it is as wide as Student's.
    """
    if groups == 1:
        return TAIL  # all resamples are the same
    return float(special.ndtr(special.stdtrit(groups - 1, TAIL) * np.sqrt(groups / (groups - 1))))


def _resamples(count: int, groups: Sequence[Any] | None, seed: int) -> np.ndarray:
    """Return the tables of each resample `[RESAMPLES, K]`; -1 fills up the rows of small groups."""
    rng = np.random.default_rng(seed)
    names = np.arange(count) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    members = [np.flatnonzero(names == name) for name in range(names.max() + 1)]
    sizes = np.array([len(rows) for rows in members])
    table = np.stack([np.resize(rows, sizes.max()) for rows in members])
    chosen = rng.integers(0, len(members), (RESAMPLES, len(members)))
    within = (rng.uniform(size=(RESAMPLES, len(members), sizes.max())) * sizes[chosen][..., None]).astype(int)
    pick = table[chosen[..., None], within]
    return np.where(np.arange(sizes.max()) < sizes[chosen][..., None], pick, -1).reshape(RESAMPLES, -1)


def _total(values: np.ndarray, pick: np.ndarray) -> np.ndarray:
    """Return the sum of `values` of each resample."""
    return np.append(values, 0.0)[pick].sum(-1)


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
