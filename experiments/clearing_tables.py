"""The tables of docs/clearing.md, from the numbers of `clearing_numbers`."""

from __future__ import annotations

import textwrap
from typing import Any, get_args

from dipn_jax.eval.clearing import sweeping
from dipn_jax.eval.report import paper

from dipn_jax.commands import markdown
from dipn_jax.names import ALL_AIDS, MethodName
from experiments.clearing_numbers import PUSH_OR_NOT

TITLES = {
    "completion": "completion",
    "grasps_that_held": "grasps that held",
    "grasp_success_all": "objects per grasp",
    "efficiency_all": "objects per action",
}
"""Titles of the measures."""
DIFFERENCES = {"difference": "objects per action, more than DIPN+GN", "over_gn": "more than GN alone"}
"""Titles of the differences of a table, in percentage points."""


def _cell(values: dict[str, Any], at: str) -> str:
    """Return a share in per cent, with its interval, and its spread where there are several trainings."""
    if values.get(at) is None:
        return "-"
    value, low, high = (100 * values[f"{at}{end}"] for end in ("", "_low", "_high"))
    several = values.get(f"{at.rpartition('/')[0]}/trainings", 1) > 1
    spread = f" ({100 * values[f'{at}_spread']:.1f})" if several else ""
    return f"{value:.1f} [{low:.0f}, {high:.0f}]{spread}"


def _difference(values: dict[str, Any], at: str) -> str:
    """Return a difference in percentage points with its interval, bold where that excludes zero; empty if unknown."""
    if values.get(at) is None:
        return ""
    value, low, high = (100 * values[f"{at}{end}"] for end in ("", "_low", "_high"))
    sure = "**" if (low > 0 or high < 0) and low < high else ""
    value, low, high = (round(number, 1) + 0.0 for number in (value, low, high))  # no -0.0
    return f"{sure}{value:+.1f}{sure} [{low:+.1f}, {high:+.1f}]"


def multiplicity(values: dict[str, Any]) -> str:
    """Return a sentence with the number of differences on the page, and of those whose interval excludes zero."""
    shown = [key for key in values if key.endswith(("efficiency_all_difference", "efficiency_all_over_gn"))]
    ends = [(values[f"{key}_low"], values[f"{key}_high"]) for key in shown]
    sure = sum(low < high and not low <= 0 <= high for low, high in ends)
    said = (
        f"The tables below show {len(shown)} differences, each with an interval of its own; {sure} of these exclude "
        f"zero (bold), and about {max(1, round(len(shown) / 20))} would by chance if no method differed from another."
    )
    return textwrap.fill(said, 120, break_on_hyphens=False)


def _table(values: dict[str, Any], head: str, rows: dict[str, str]) -> str:
    """Return a table of the groups `rows`, title by name, as far as they are there."""
    lines = []
    for at, title in rows.items():
        if f"{at}/tables" in values:
            cells = [str(values[f"{at}/tables"]), str(values[f"{at}/pushes"])]
            cells += [_cell(values, f"{at}/{key}") for key in TITLES]
            lines.append([title, *cells, *(_difference(values, f"{at}/efficiency_all_{end}") for end in DIFFERENCES)])
    used = [column for column in range(len(DIFFERENCES)) if any(line[6 + column + 1] for line in lines)]
    titles = [title for column, title in enumerate(DIFFERENCES.values()) if column in used]
    lines = [[*line[:7], *(line[7 + column] for column in used)] for line in lines]
    return markdown.table([head, "tables", "pushes", *TITLES.values(), *titles], lines)


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
        if on == "heldout":
            rows["hindsight/luck"] = "the better of dipn+gn and itself with 2 mm of noise, in hindsight"
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
    "heldout": "Held-out hard tables: no constant was chosen by them",
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
    for aid in ALL_AIDS:
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
    return f"\n{multiplicity(values)}\n\n" + "".join(f"## {title}\n\n{text}\n" for title, text in parts.items() if text)


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
