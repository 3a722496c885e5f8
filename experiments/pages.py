"""The pages of results in docs: their tables, and a box with the machines, commits and seeds of their runs."""

from __future__ import annotations

import pathlib
import textwrap
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine
from experiments import runs
from experiments.runs import NOT_RECORDED, Run

DOCS = pathlib.Path(__file__).parent.parent / "docs"
"""The folder of the pages."""

BOX_BEGINS = "<!-- box: begin -->"
"""Line of a page after which its box stands."""
BOX_ENDS = "<!-- box: end -->"
"""Line of a page before which its box ends."""
TABLES_BEGIN = "<!-- tables: begin -->"
"""Line of a page after which tables stand that come and go with the results."""
TABLES_END = "<!-- tables: end -->"
"""Line of a page before which they end."""
BOX_WIDTH = 110
"""Length of a line of the box in characters."""

MADE = "made"
"""Key of a page's JSON that holds what `made` returns; all other keys are numbers."""

SHOWN = ("jax", "mujoco", "warp-lang")
"""Packages whose versions stand in a box, where they are known."""


def made(listed: Sequence[Run]) -> dict[str, Any]:
    """Return what the stamps of runs say about how they were made, by name of run, as JSON."""
    facts = ("made_by", "seed", "versions")
    stamps = {run.name: runs.read_stamp(run) for run in listed}
    return {name: {key: stamp[key] for key in facts if key in stamp} for name, stamp in stamps.items()}


def made_here(seed: int | None) -> dict[str, Any]:
    """Return what `made` says of a run: that it was made by this process, with this seed."""
    here = {"commit": machine.commit(), "processor": machine.processor(), "cores": machine.cores()}
    return {"made_by": [here], "seed": seed, "versions": files.package_versions()}


def box(values: dict[str, Any]) -> str:
    """Return the box of a page as Markdown: number of figures, and machines, commits, versions and seeds of its runs.

    Args:
      values: a page's JSON: numbers by name, and under `made`, if they are known, the facts about its runs. Where they
        were written by hand, after runs that kept no stamps, a name may stand for several runs, with a list of seeds.
    """
    found = values.get(MADE, {})
    lines = [f"figures: {sum(key != MADE for key in values):,}"]
    for title, describe in (("machine", _machines), ("commit", _commits), ("versions", _versions), ("seed", _seeds)):
        lines.append(f"{title}: {_grouped({name: describe(facts) for name, facts in found.items()})}")
    wrapped = [textwrap.fill(line, BOX_WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in lines]
    return "\n".join(["```", *wrapped, "```"]) + "\n"


def _machines(facts: dict[str, Any]) -> str:
    names = [
        each["processor"] + (f", {each['cores']} core{'s' * (each['cores'] > 1)}" if each["cores"] else "")
        for each in facts.get("made_by", [])
    ]
    return " and ".join(dict.fromkeys(names)) or NOT_RECORDED


def _commits(facts: dict[str, Any]) -> str:
    return " and ".join(dict.fromkeys(each["commit"] for each in facts.get("made_by", []))) or NOT_RECORDED


def _versions(facts: dict[str, Any]) -> str:
    found = facts.get("versions", {})
    return ", ".join(f"{name} {found[name]}" for name in SHOWN if name in found) or NOT_RECORDED


def _seeds(facts: dict[str, Any]) -> str:
    if "seed" not in facts:
        return NOT_RECORDED
    seeds = facts["seed"] if isinstance(facts["seed"], list) else [facts["seed"]]
    return ", ".join("none" if seed is None else f"{seed:,}" for seed in seeds)


def _grouped(by_run: dict[str, str]) -> str:
    """Return each value once, with the runs that have it; the commonest goes last, without their names if several."""
    if not by_run:
        return NOT_RECORDED
    groups: dict[str, list[str]] = {}
    for run, value in by_run.items():
        groups.setdefault(value, []).append(run)
    *few, most = sorted(groups, key=lambda value: len(groups[value]))
    named = [f"{value} ({', '.join(groups[value])})" for value in few]
    others = ", ".join(groups[most]) if len(groups[most]) == 1 else "all others"
    return "; ".join([*named, f"{most} ({others})" if few else most])


def with_box(text: str, content: str) -> str:
    """Return the page `text` with `content` as its box.

    Raises:
      UserError: the page has no markers for it.
    """
    return _between(text, content, BOX_BEGINS, BOX_ENDS, "box")


def with_tables(text: str, content: str) -> str:
    """Return the page `text` with `content` as its section of tables.

    Raises:
      UserError: the page has no markers for it.
    """
    return _between(text, content, TABLES_BEGIN, TABLES_END, "tables")


def _between(text: str, content: str, begin: str, end: str, what: str) -> str:
    before, begins, rest = text.partition(f"{begin}\n")
    _, ends, after = rest.partition(f"{end}\n")
    if not begins or not ends:
        raise UserError(f"the page has no place for its {what}: add the lines {begin} and {end}")
    return f"{before}{begins}{content}{ends}{after}"


def with_table(text: str, table: str) -> str:
    """Return the page `text` with `table` instead of the table with the same heading.

    Raises:
      UserError: no table of the page, or more than one, has that heading.
    """
    heading = "".join(table.splitlines(keepends=True)[:2])
    before, found, after = text.partition(heading)
    if not found or heading in after:
        raise UserError(f"the page needs one table with this heading: {heading.splitlines()[0]}")
    rows = after.splitlines(keepends=True)
    while rows and rows[0].startswith("|"):
        rows.pop(0)
    return before + table + "".join(rows)


def write(
    name: str, values: dict[str, Any], tables: Sequence[str], *, docs: pathlib.Path, section: str | None = None
) -> None:
    """Write `NAME.json` and put the tables and the box into `NAME.md`, which must have places for them.

    Args:
      name: name of the page.
      values: its JSON.
      tables: tables as Markdown.
      docs: folder of the page.
      section: tables that come and go with the results, as Markdown with headings.
    """
    page = docs / f"{name}.md"
    text = with_box(files.read_text(page), box(values))
    if section is not None:
        text = with_tables(text, section)
    for table in tables:
        text = with_table(text, table)
    files.write_json(docs / f"{name}.json", values)
    files.write_text(page, text)
    console.say(f"{page}: {len(tables)} tables")
