"""The tables of results as Markdown and CSV."""

import csv
import io
import pathlib

import pytest
from dipn_jax.eval.report import paper, results, tabular
from dipn_jax.eval.report.cleared import Cleared

from dipn_jax.system import files
from experiments.fuzz_parsers import PARSERS

NASTY = 'a|b\n<b>"x", *y*</b> $z$ `c` [d](e) \\'
"""A label of a user's that is markup and more than one line."""


@pytest.fixture
def rows(tmp_path: pathlib.Path) -> list[Cleared]:
    """Return two evaluations of the same table, one of which has a label."""
    for name, label in (("one", ""), ("two", NASTY)):
        (tmp_path / name).mkdir()
        PARSERS["film"].prepare(tmp_path / name)
        settings = files.read_json(tmp_path / name / "settings.json")
        recorded = {
            "tables.names": [],
            "tables.instances": 1,
            "tables.as_placed": False,
            "seed": 0,
            "files": {"a": "b"},
        }
        files.write_json(tmp_path / name / "settings.json", settings | recorded | {"label": label})
    return [Cleared(tmp_path / name) for name in ("one", "two")]


def test_csv_has_the_numbers_of_the_metrics_and_of_the_paper(rows: list[Cleared]) -> None:
    found = results.grouped(rows, against="gn")
    ours, labelled, *published = csv.DictReader(io.StringIO(tabular.as_csv(found)))
    for one, line in zip(rows, (ours, labelled), strict=True):
        assert (line["source"], line["tables"], line["method"], line["label"]) == ("here", "hard", "gn", one.label)
        told = {name: float(line[name]) for name in line if name in one.values}
        assert told == {name: one.values[name] for name in told} and "grasps_that_held_low" in told and "grasps" in told
    assert {name: line for name, line in labelled.items() if name.startswith(("against", results.DIFFERENCE))} == {
        "against": "gn", results.DIFFERENCE: "0.0", f"{results.DIFFERENCE}_low": "", f"{results.DIFFERENCE}_high": "",
    }  # fmt: skip
    assert ours["against"] == ours[results.DIFFERENCE] == ""
    assert [line["method"] for line in published] == list(paper.TABLE["hard"])
    theirs = published[-1]
    assert (theirs["source"], theirs["efficiency_all"], theirs["grasps_that_held"]) == ("paper", "0.744", "")


def test_markdown_has_the_cells_of_the_page_and_what_is_said_below(rows: list[Cleared]) -> None:
    found = results.grouped(rows, against="gn")
    title, _, head, rule, *lines = tabular.as_markdown(found).splitlines()
    assert title == "## hard" and head.endswith("| efficiency all, points from gn |")
    cells = [line.replace("\\|", "").count("|") for line in (head, rule, *lines[:6])]
    assert len(set(cells)) == 1 and lines[6] == "", "each label is one cell: two rows, and four of the paper"
    assert lines[1].startswith(r'| gn (a\|b \<b\>"x", \*y\*\</b\> \$z\$ \`c\` [d\](e) \\) | 1 |')
    below = "\n".join(lines[7:])
    assert "All rows: --instances 1, --seed 0." in below and "Points from gn: " in below and results.NOTE in below
