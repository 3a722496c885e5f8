"""The numbers and tables of docs/clearing.md, from results that are kept table by table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import lockstep, sweeping
from dipn_jax.eval.report import paper

from dipn_jax.commands import markdown
from dipn_jax.names import ALL_AIDS, MethodName
from experiments import runs
from experiments.kept_results import Kept
from experiments.runs import Run

Trainings = dict[str, list[lockstep.Outcome]]
"""Tables that the trainings of one method cleared, by the seed of the training."""
ABLATED = ALL_AIDS
"""Aids that are left out, and left alone, one after the other."""
OURS = "dipn+gn"
"""The method that the others are compared with."""
MEASURES = (*paper.COLUMNS[:1], "grasps_that_held", "grasp_success_all", "efficiency_all")
"""Measures of the tables."""
TITLES = {
    "completion": "completion",
    "grasps_that_held": "grasps that held",
    "grasp_success_all": "objects per grasp",
    "efficiency_all": "objects per action",
}
"""Titles of the measures."""


def numbers(listed: Sequence[Run], kept: Kept) -> dict[str, Any]:
    """Return all numbers of the page by name; those of runs that are not kept are not there.

    Of several trainings of one method there are the ratio over all their tables, `_spread` (the largest less the
    smallest ratio), and the interval for these trainings, over cases, then over their tables; `_less` is the difference
    from DIPN+GN on the same tables, of the trainings of the same seed.
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
        ours = groups.get(_rival(name))
        if ours and ours is not trainings:
            values |= {f"{name}/{key}": value for key, value in _compared(trainings, ours).items()}
    return values


def _hindsight(groups: dict[str, Trainings]) -> dict[str, Trainings]:
    """Return, for the hard kinds of tables, the better of the outcomes with and without pushes, chosen table by table.

    The better one has removed more; of two that have removed as much, the one with fewer actions. So nobody can choose:
    it says how much a rule that knows when to push could win at most, with these networks.
    """
    found: dict[str, Trainings] = {}
    for on in ("heldout", "hard"):
        both = [groups.get(f"table/{on}/shipped/all/{method}") for method in PUSH_OR_NOT]
        if both[0] and both[1]:
            pairs = zip(*(one["0"] for one in both if one), strict=True)
            better = [max(pair, key=lambda one: (one.removed, -one.grasps - one.pushes)) for pair in pairs]
            found[f"hindsight/{on}"] = {"0": better}
    return found


def _group(name: str) -> str:
    """Return the name of a run without the number of its training."""
    return name.rpartition("/")[0] if name.startswith("table/") else name


def _rival(name: str) -> str:
    """Return the group that a group is compared with: DIPN+GN on the same tables, as it is shipped."""
    if name.startswith("table/"):
        return f"{name.rpartition('/')[0]}/{OURS}"
    if name.startswith(("masks/", "hindsight/")):
        return f"table/{name.split('/')[1]}/shipped/all/{OURS}"
    if name.startswith("changed/"):
        return f"{name.rpartition('/')[0]}/{OURS}"
    return f"table/heldout/shipped/all/{OURS}"


def _measured(trainings: Trainings) -> dict[str, Any]:
    every = [table for tables in trainings.values() for table in tables]
    values: dict[str, Any] = {"tables": len(every), "trainings": len(trainings)}
    values["grasps"], values["pushes"] = (sum(getattr(one, kind) for one in every) for kind in ("grasps", "pushes"))
    cases = [table.name for table in every]
    each = [lockstep.counts(tables) for tables in trainings.values()]
    for key, (hits, trials) in lockstep.counts(every).items():
        value, low, high = metrics.ratio_interval(hits, trials, groups=cases)
        values |= {key: value, f"{key}_low": low, f"{key}_high": high}
        ratios = [one[key][0].sum() / max(one[key][1].sum(), 1) for one in each]
        values[f"{key}_spread"] = float(np.ptp(ratios))
    for reason in ("pushed out", "out of actions", "fault"):
        values[f"ended_{reason.replace(' ', '_')}"] = sum(table.ended == reason for table in every)
    return {
        key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in values.items()
    }


def _compared(theirs: Trainings, ours: Trainings) -> dict[str, Any]:
    """Return differences from DIPN+GN, paired by the seed of the training and by table; empty if no seed is in both."""
    both = [seed for seed in theirs if seed in ours] if len(theirs) > 1 or len(ours) > 1 else None
    sets = [(theirs[seed], ours[seed]) for seed in both] if both is not None else [(*theirs.values(), *ours.values())]
    if not sets:
        return {}
    pairs = [pair for one, other in sets for pair in zip(one, other, strict=True)]
    if any(a.name != b.name for a, b in pairs):
        raise ValueError("tables of other cases, or in another order, cannot be compared")
    cases = [a.name for a, _ in pairs]
    sides = [lockstep.counts([pair[i] for pair in pairs]) for i in range(2)]
    values: dict[str, Any] = {}
    for key in MEASURES:
        value, low, high = metrics.ratio_difference(sides[0][key], sides[1][key], cases)
        values |= {f"{key}_less": value, f"{key}_less_low": low, f"{key}_less_high": high}
    return values


def _cell(values: dict[str, Any], at: str) -> str:
    """Return a share in per cent, with its interval, and its spread where there are several trainings."""
    if values.get(at) is None:
        return "-"
    value, low, high = (100 * values[f"{at}{end}"] for end in ("", "_low", "_high"))
    several = values.get(f"{at.rpartition('/')[0]}/trainings", 1) > 1
    spread = f" ({100 * values[f'{at}_spread']:.1f})" if several else ""
    return f"{value:.1f} [{low:.0f}, {high:.0f}]{spread}"


def _difference(values: dict[str, Any], at: str) -> str:
    if values.get(f"{at}_less") is None:
        return ""
    value, low, high = (100 * values[f"{at}_less{end}"] for end in ("", "_low", "_high"))
    sure = "**" if low > 0 or high < 0 else ""
    return f"{sure}{value:+.1f}{sure} [{low:+.1f}, {high:+.1f}]"


def _table(values: dict[str, Any], head: str, rows: dict[str, str]) -> str:
    """Return a table of the groups `rows`, title by name, as far as they are there."""
    lines = []
    for at, title in rows.items():
        if f"{at}/tables" in values:
            cells = [str(values[f"{at}/tables"]), str(values[f"{at}/pushes"])]
            cells += [_cell(values, f"{at}/{key}") for key in TITLES]
            lines.append([title, *cells, _difference(values, f"{at}/efficiency_all")])
    return markdown.table([head, "tables", "pushes", *TITLES.values(), "objects per action, difference"], lines)


PUSH_OR_NOT = ("gn", "dipn+gn+actions")
"""Methods of which the better one is chosen in hindsight."""


def of_methods(values: dict[str, Any], on: str, aids: str) -> str:
    """Return a table of all methods on one kind of tables, in per cent; of bare ones with the paper's numbers.

    Empty if nothing is known of any.
    """
    rows = {
        (at := f"table/{on}/{budget}/{aids}/{method}"): f"{method}, {budget}{_trainings(values, at)}"
        for budget in ("shipped", "large", "paper")
        for method in get_args(MethodName)
    }
    if not any(f"{at}/tables" in values for at in rows):
        return ""
    if aids == "all":
        rows[f"hindsight/{on}"] = f"the better of {' and '.join(PUSH_OR_NOT)}, in hindsight"
    text = _table(values, f"{on}, {'all aids' if aids == 'all' else 'bare'}", rows)
    for method, published in paper.TABLE.get(on, {}).items() if aids == "bare" else ():
        found = dict(zip(paper.COLUMNS, published, strict=True))
        cells = [f"{found[key]:.1f}" if key in found else "" for key in TITLES]
        text += f"| *{method}, the paper* | | | {' | '.join(cells)} | |\n"
    return text


def _trainings(values: dict[str, Any], at: str) -> str:
    """Return how many trainings a row is of, in parentheses; empty for the networks that come with the package."""
    number = 0 if "/shipped/" in at else values.get(f"{at}/trainings", 0)
    return f" ({number} training{'s' * (number > 1)})" if number else ""


SECTIONS = {
    "heldout": "Held-out hard tables: nothing was chosen by them",
    "hard": "The ten hard tables of the paper, by which aids and constants were chosen",
    "random-10": "10 objects, dropped at random",
    "random-30": "30 objects, dropped at random",
}
"""Kinds of tables in the order of the page, and their titles."""


def section(values: dict[str, Any]) -> str:
    """Return all tables of the page that have rows, with headings, but the one of the sweep."""
    shipped, parts = "table/{}/shipped/all/dipn+gn", {}
    for on, title in SECTIONS.items():
        parts[title] = "\n".join(text for aids in ("all", "bare") if (text := of_methods(values, on, aids)))
    masks: dict[str, str] = {}
    for on in SECTIONS:
        if f"masks/{on}/true/tables" in values:
            masks |= {shipped.format(on): f"{on}, found in the image", f"masks/{on}/true": f"{on}, the simulator's"}
    base = {shipped.format("heldout"): "as it is"}
    aids: dict[str, str] = {}
    for aid in ABLATED:
        aids |= {f"aids/without/{aid}": f"all but `{aid}`", f"aids/alone/{aid}": f"`{aid}` alone"}
    distance = {"distance/chosen": "3 to 12 cm, chosen for each push"}
    others: tuple[tuple[str, str, dict[str, str], dict[str, str]], ...] = (
        ("Masks", "masks of DIPN+GN", {}, masks),
        ("Noise of the camera", "noise, DIPN+GN on held-out tables", base, _named(values, "noise")),
        (
            "What each aid is worth",
            "aids, DIPN+GN on held-out tables",
            base,
            aids,
        ),
        ("Changed worlds", "random tables", {}, _worlds(values)),
        ("A distance for every push", "push, DIPN+GN on held-out tables", base, distance),
    )
    for title, head, first, rows in others:
        there = {at: name for at, name in rows.items() if f"{at}/tables" in values}
        parts[title] = _table(values, head, first | there) if there else ""
    return "\n" + "".join(f"## {title}\n\n{text}\n" for title, text in parts.items() if text)


def _named(values: dict[str, Any], kind: str) -> dict[str, str]:
    """Return the groups of a kind, title by name."""
    found = [key.rpartition("/")[0] for key in values if key.startswith(f"{kind}/") and key.endswith("/tables")]
    return {group: ", ".join(group.split("/")[1:]) for group in found}


NETWORKS = {"": "shipped", "paper": "paper", "unseen": "paper, trained without arches"}
"""Networks of the table of changed worlds by the part of a run's name, and their titles."""


def _worlds(values: dict[str, Any]) -> dict[str, str]:
    """Return the groups of changed worlds, title by name, world after world."""
    titles = {}
    for at in _named(values, "changed"):
        _, world, *networks, method = at.split("/")
        titles[at] = f"{world}: {method}, {NETWORKS[''.join(networks)]}"
    worlds = list(dict.fromkeys(at.split("/")[1] for at in titles))
    return dict(sorted(titles.items(), key=lambda pair: worlds.index(pair[0].split("/")[1])))


def swept(values: dict[str, Any]) -> str:
    """Return a table of what `dipn-eval sweep` found at each distance; errors are true 1-IoU of moved objects."""
    rows = []
    for each in sweeping.names(values):
        at = f"sweep/{each}"
        error = values.get(f"{at}/push_error/moved")
        name = each if error is None else f"{100 * float(each):.0f} cm"
        cells = [_cell(values, f"{at}/{key}") for key in sweeping.SHOWN]
        rows.append([name, "-" if error is None else f"{error:.3f}", *cells, str(values[f"{at}/pushes"])])
    head = ["push", "error, moved objects", "completion", "objects per grasp", "objects per action", "pushes"]
    return markdown.table(head, rows)
