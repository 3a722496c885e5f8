"""Success rates of grasps that were tried, and the calibration of their scores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from dipn_jax.storage.arrays import Form

from .. import metrics
from ..clearing import lockstep
from ..clearing.instances import Instance
from ..clearing.lockstep import Outcome

Arrays = dict[str, np.ndarray]
"""What was tried, by the names of FORMS."""
FORMS = {
    "table": Form("iu", ("A",)),  # of each grasp: the number of its table
    "held": Form("b", ("A",)),
    "score": Form("f", ("A",)),
    "random_table": Form("iu", ("T",)),  # of each grasp of a random pixel
    "random_usable": Form("b", ("T",)),  # nothing went wrong in its simulation
    "random_success": Form("b", ("T",)),
    "random_score": Form("f", ("T",)),
    "missed_table": Form("iu", ("M",)),  # of each grasp that missed, where others were tried
    "missed_held": Form("b", ("M",)),  # one of them would have held
    "single_scene": Form("iu", ("S",)),  # of each grasp of a single object
    "single_usable": Form("b", ("S",)),
    "single_label": Form("b", ("S",)),  # what pre-training says of it
    "single_held": Form("b", ("S",)),
}
"""Arrays of what was tried; the first of each kind has the table or scene of each grasp, in order of which they are."""
BINS = 10
"""Number of bins of scores."""


def rates(found: Arrays, tables: Sequence[Outcome] | Sequence[Instance], *, others: int) -> dict[str, Any]:
    """Return flat metrics of what was tried on all tables: success and calibration.

    Success has bootstrap 95 % intervals over tables.

    Args:
      found: as `tried` returns it.
      tables: how they ended.
      others: as of `tried`.
    """
    result = _random_rates(found)
    held, count = found["held"].astype(float), len(tables)
    trials = np.bincount(found["table"], minlength=count)
    first = np.unique(found["table"], return_index=True)[1]
    result |= _rate("gn", np.bincount(found["table"], held, minlength=count), trials)
    result |= _rate("gn_first", held[first], np.ones(len(first)))
    result |= {f"table/{key}": value for key, value in lockstep.summary(tables).items() if key.startswith("ended_")}
    result |= {"attempts": len(held), "scenes": count}
    result |= calibration(found["score"], held)
    return result | (_other_rates(found, others) if others else {})


def _rate(name: str, hits: Any, trials: Any) -> dict[str, float]:
    value, low, high = metrics.ratio_interval(hits, trials)
    return {f"grasp_success/{name}": value, f"grasp_success/{name}_low": low, f"grasp_success/{name}_high": high}


def _random_rates(found: Arrays) -> dict[str, Any]:
    """Return success rates of the usable grasps at random pixels."""
    good = found["random_usable"]
    success = found["random_success"].astype(float)[good]
    said = calibration(found["random_score"][good], success)
    return _rate("random_foreground", success, np.ones(len(success))) | {f"random/{k}": v for k, v in said.items()}


def _other_rates(found: Arrays, count: int) -> dict[str, float]:
    """Return how often one of the `count` next best grasps would have held where GN missed."""
    one_held = found["missed_held"]
    result: dict[str, float] = {"other_grasps/missed": len(one_held), "other_grasps/tried_each": count}
    if not len(one_held):
        return result
    result["other_grasps/one_holds"] = float(one_held.mean())
    return result | {"other_grasps/ceiling": 1 - float((~one_held).sum()) / len(found["table"])}


def label_rates(found: Arrays) -> dict[str, float]:
    """Return how often labels agree with physics, over the usable grasps."""
    said, held = (found[name][found["single_usable"]] for name in ("single_label", "single_held"))
    agreed = {"agree": said == held, "positive_holds": held[said], "negative_fails": ~held[~said], "positive": said}
    return {"grasps": len(said)} | {name: float(np.mean(rate)) for name, rate in agreed.items()}


def calibration(scores: np.ndarray, success: np.ndarray) -> dict[str, float]:
    """Return the expected calibration error over ten equal bins of score (Naeini et al. 2015), and the bins.

    Args:
      scores: `[A]` in [0, 1].
      success: `[A]` 0 or 1.
    """
    bins = np.clip((scores * BINS).astype(int), 0, BINS - 1)
    result: dict[str, float] = {}
    error = 0.0
    for b in range(BINS):
        inside = bins == b
        if inside.any():
            said, came = float(scores[inside].mean()), float(success[inside].mean())
            error += float(inside.mean()) * abs(came - said)
            result |= {f"reliability/{b}/count": int(inside.sum()), f"reliability/{b}/score": said}
            result[f"reliability/{b}/success"] = came
    return {"expected_calibration_error": error, **result}


def reliability_figure(values: dict[str, Any]) -> Any:
    """Plot success against score: the grasps that GN chose, and random ones."""
    figure, axis = plt.subplots(figsize=(4.2, 4))
    axis.plot([0, 1], [0, 1], color="grey", lw=1)
    for prefix, label in (("", "chosen by GN"), ("random/", "random")):
        found = [b for b in range(BINS) if f"{prefix}reliability/{b}/count" in values]
        points = [[values[f"{prefix}reliability/{b}/{key}"] for b in found] for key in ("score", "success", "count")]
        label += f", ECE {values[f'{prefix}expected_calibration_error']:.3f}"
        axis.plot(points[0], points[1], marker="o", label=label)
        for x, y, n in zip(*points, strict=True):
            axis.annotate(str(int(n)), (x, y), fontsize=6, xytext=(3, -8), textcoords="offset points")
    axis.set(xlabel="score", ylabel="share that held", xlim=(0, 1), ylim=(0, 1.02))
    axis.legend(fontsize=8)
    return figure
