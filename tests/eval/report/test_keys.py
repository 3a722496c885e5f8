"""The page of concepts lists the keys that evaluations write, and no others."""

import pathlib
import re
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval import curves
from dipn_jax.eval.clearing import lockstep, sweeping
from dipn_jax.eval.grasping import merging as grasping
from dipn_jax.eval.grasping import rates
from dipn_jax.eval.prediction import merging as prediction
from dipn_jax.eval.prediction import push_errors
from dipn_jax.eval.report import page

from dipn_jax.system import files
from experiments.fuzz_parsers import PARSERS

PAGE = pathlib.Path(__file__).parents[3] / "docs" / "concepts.md"
TABLES = [lockstep.Outcome("01", "cleared", objects=2, removed=2, held=2, grasps=2, pushes=1)]


def _documented() -> dict[str, list[str]]:
    """Return the keys on the page by command."""
    section = PAGE.read_text().partition("## The keys of the metrics")[2].partition("\n## ")[0]
    found: dict[str, list[str]] = {}
    for line in section.splitlines():
        if line.startswith("| ") and "`" in line:
            _, command, keys, *_ = line.split("|")
            found.setdefault(command.strip(), []).extend(re.findall("`(.*?)`", keys))
    return found


def _sweep(_: pathlib.Path) -> dict[str, Any]:
    found = {"error": np.ones((1, 1, 2)), "count": np.ones((1, 1, 2))}
    cleared = {f"sweep/{name}/{key}": value for name in ("0.1", "chosen") for key, value in _clear(_).items()}
    return cleared | sweeping.error_rates(found, ["0.1"])


def _grasp(out: pathlib.Path) -> dict[str, Any]:
    found = {
        name: np.zeros(2, bool if form.kinds == "b" else float if form.kinds == "f" else int)
        for name, form in rates.FORMS.items()
    } | {"random_usable": np.ones(2, bool), "single_usable": np.ones(2, bool), "single_label": np.array([True, False])}
    online = curves.grasp_summary({"with": {10: [0.5]}, "without": {10: [0.5]}})
    return grasping.finish(out, found, TABLES, others=2, online=online)


def _prediction(out: pathlib.Path) -> dict[str, Any]:
    rows = {name: np.ones((1, 2, 3), bool) for name in ("visible", "moved")}
    for name in ("dipn", "static", "trans", "physics", "100/0"):
        for suffix in ("", push_errors.SEGMENTED):
            for key in ("push_error", "push_error_paper_measure", "push_position_mm", "push_angle_deg"):
                rows[f"{name}{suffix}/{key}"] = np.ones((1, 2, 3))
    return prediction.finish(out, rows, ["100/0"])


def _clear(_: pathlib.Path) -> dict[str, Any]:
    return lockstep.summary(TABLES)


def _report(out: pathlib.Path) -> dict[str, Any]:
    folders = []
    for label in ("", "a", "b"):
        folders.append(out / f"in-{label}")
        folders[-1].mkdir()
        PARSERS["film"].prepare(folders[-1])
        settings = files.read_json(folders[-1] / "settings.json")
        files.write_json(folders[-1] / "settings.json", settings | {"label": label})
    return page.write(out, page.Sources(clears=folders), against="a")


WRITERS = {"clear": _clear, "sweep": _sweep, "grasp": _grasp, "prediction": _prediction, "report": _report}
"""What each command writes as metrics, from a little that is made up."""


@pytest.mark.parametrize("command", WRITERS)
def test_the_keys_on_the_page_are_those_that_are_written(command: str, tmp_path: pathlib.Path) -> None:
    documented = _documented()
    written = {re.sub("_(low|high)$", "", key) for key in WRITERS[command](tmp_path)}
    measures = "|".join(map(re.escape, documented["clear"]))
    patterns = {
        key: re.sub("[A-Z]+", lambda word: f"({measures})" if word[0] == "KEY" else "[^/]+", key)
        for key in documented[command]
    }
    matched = {key: [one for one in written if re.fullmatch(pattern, one)] for key, pattern in patterns.items()}
    assert {key for key, found in matched.items() if not found} == set(), "on the page, but not written"
    assert written - {one for found in matched.values() for one in found} == set(), "written, but not on the page"
