"""The numbers of docs/clearing.md by name, from results that are kept table by table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import lockstep

from experiments import runs
from experiments.kept_results import Kept
from experiments.runs import Run

Trainings = dict[str, list[lockstep.Outcome]]
"""Tables that the trainings of one method cleared, by the seed of the training."""
OURS = "dipn+gn"
"""The method that the others are compared with."""
NO_PUSHES = "gn"
"""The method without pushes, with which those that push are compared, too."""
MEASURES = ("completion", "grasps_that_held", "grasp_success_all", "efficiency_all")
"""Measures of the tables."""
PUSH_OR_NOT = ("gn", "dipn+gn+actions")
"""Methods of which the better one is chosen in hindsight."""
TWIN = "height-2mm"
"""Noise with which DIPN+GN is its own twin."""


def numbers(listed: Sequence[Run], kept: Kept) -> dict[str, Any]:
    """Return all numbers of the page by name; those of runs that are not kept are not there.

    Of several trainings of one method there are the ratio over all their tables, `_spread` (the largest less the
    smallest ratio), and the interval for these trainings, over cases, then over their tables. `_difference` is how much
    more it is than with DIPN+GN on the same tables, of the trainings of the same seed, and `_over_gn` than with GN
    alone. Trainings clear the same tables, so what they did on a table counts together.
    """
    groups: dict[str, Trainings] = {}
    for run, key in zip(listed, runs.keys(listed).values(), strict=True):
        tables = kept.tables(run, key)
        if tables is not None:
            groups.setdefault(_group(run.name), {})[run.name.rpartition("/")[2]] = tables
    groups |= _hindsight(groups)
    values: dict[str, Any] = {}
    for name, trainings in groups.items():
        values |= {f"{name}/{key}": value for key, value in _measured(trainings).items()}
        for end, method in _rivals(name).items():
            ours = groups.get(_rival(name, method))
            if ours and ours is not trainings:
                values |= {f"{name}/{key}_{end}{part}": value for key, part, value in _compared(trainings, ours)}
    return values


def _hindsight(groups: dict[str, Trainings]) -> dict[str, Trainings]:
    """Return, for the hard kinds of tables, the better of the outcomes with and without pushes, chosen table by table.

    The better one has removed more; of two that have removed as much, the one with fewer actions. So nobody can choose.
    The better of two is better by luck alone, too: by how much, `luck` says, which chooses so between DIPN+GN and
    itself with a noise that changes nothing certain. Neither is a bound: a rule chooses state by state.
    """
    shipped, found = "table/{}/shipped/all/{}", {}
    chosen = {f"hindsight/{on}": [shipped.format(on, method) for method in PUSH_OR_NOT] for on in ("heldout", "hard")}
    chosen["hindsight/luck"] = [shipped.format("heldout", OURS), f"noise/{TWIN}"]
    for name, parts in chosen.items():
        both = [groups[part] for part in parts if part in groups]
        if len(both) == 2:
            pairs = zip(*(next(iter(one.values())) for one in both), strict=True)
            better = [max(pair, key=lambda one: (one.removed, -one.grasps - one.pushes)) for pair in pairs]
            found[name] = {"0": better}
    return found


def _group(name: str) -> str:
    """Return the name of a run without the number of its training."""
    return name.rpartition("/")[0] if name.startswith("table/") else name


def _rivals(name: str) -> dict[str, str]:
    """Return the methods that a group is compared with by the name of the difference; what is chosen, with none.

    DIPN+GN and GN alone are compared once: in the row of GN alone.
    """
    if name.startswith("hindsight/"):
        return {}
    of_a_method = name.startswith(("table/", "changed/")) and not name.endswith(f"/{OURS}")
    return {"difference": OURS} | ({"over_gn": NO_PUSHES} if of_a_method else {})


def _rival(name: str, method: str) -> str:
    """Return the group that a group is compared with: `method` on the same tables, with the same networks."""
    if name.startswith(("table/", "changed/")):
        return f"{name.rpartition('/')[0]}/{method}"
    return f"table/{name.split('/')[1] if name.startswith('masks/') else 'heldout'}/shipped/all/{method}"


def _measured(trainings: Trainings) -> dict[str, Any]:
    every = [table for tables in trainings.values() for table in tables]
    values: dict[str, Any] = {"tables": len(every), "trainings": len(trainings)}
    values["grasps"], values["pushes"] = (sum(getattr(one, kind) for one in every) for kind in ("grasps", "pushes"))
    each = [lockstep.counts(tables) for tables in trainings.values()]
    for key, (hits, trials) in _together(list(trainings.values())).items():
        value, low, high = metrics.ratio_interval(hits, trials, groups=_cases(list(trainings.values())))
        values |= {key: value, f"{key}_low": low, f"{key}_high": high}
        ratios = [one[key][0].sum() / max(one[key][1].sum(), 1) for one in each]
        values[f"{key}_spread"] = float(np.ptp(ratios))
    for reason in ("pushed out", "out of actions", "fault"):
        values[f"ended_{reason.replace(' ', '_')}"] = sum(table.ended == reason for table in every)
    return {
        key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in values.items()
    }


def _cases(trainings: Sequence[Sequence[lockstep.Outcome]]) -> list[str]:
    """Return the case of each table.

    Raises:
      ValueError: trainings have cleared other cases, or in another order.
    """
    cases = [[table.name for table in tables] for tables in trainings]
    if any(one != cases[0] for one in cases):
        raise ValueError("tables of other cases, or in another order, cannot be compared")
    return cases[0]


def _together(trainings: Sequence[Sequence[lockstep.Outcome]]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return hits and trials of each measure, by table, over all trainings."""
    each = [lockstep.counts(tables) for tables in trainings]
    return {key: tuple(np.sum([one[key][i] for one in each], 0) for i in range(2)) for key in each[0]}


def _compared(theirs: Trainings, ours: Trainings) -> Iterator[tuple[str, str, float]]:
    """Yield measures with differences and their ends, paired by the seed of the training and by table.

    Nothing if no seed is in both.
    """
    both = [seed for seed in theirs if seed in ours] if len(theirs) > 1 or len(ours) > 1 else None
    sets = [(theirs[seed], ours[seed]) for seed in both] if both is not None else [(*theirs.values(), *ours.values())]
    if not sets:
        return
    cases = _cases([tables for pair in sets for tables in pair])
    sides = [_together([pair[i] for pair in sets]) for i in range(2)]
    for key in MEASURES:
        found = metrics.ratio_difference(sides[0][key], sides[1][key], cases)
        yield from ((key, end, value) for end, value in zip(("", "_low", "_high"), found, strict=True))
