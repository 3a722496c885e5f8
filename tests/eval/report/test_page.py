import html.parser
import json
import pathlib
import shutil
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval import metrics
from dipn_jax.eval.prediction import push_errors
from dipn_jax.eval.report import page

from dipn_jax.errors import UserError
from dipn_jax.storage import checkpoint
from dipn_jax.storage.resume import Partial
from dipn_jax.system import files
from dipn_jax.world import scenes
from experiments.fuzz_parsers import PARSERS

CONFIG = scenes.fixed_count(3, spread=0.2)


def test_learning_curves_show_the_measures_that_exist(tmp_path: pathlib.Path) -> None:
    lines = [{"step": 10, "reward/grasp": 0.5}, {"step": 20, "reward/push": 0.25}, {"step": 30, "reward/grasp": 0.75}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    drawn = {line.get_label(): line.get_xydata().tolist() for line in page._curves([tmp_path]).axes[0].lines}
    assert drawn == {"reward/grasp": [[10, 0.5], [30, 0.75]], "reward/push": [[20, 0.25]]}


@pytest.mark.slow
def test_the_report_is_one_file_with_its_pictures(
    cleared: Any, engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    network = {"dipn": checkpoint.load_network(runs["dipn"], network="dipn")}
    rows, films = push_errors.measured(
        network, engine, CONFIG, Partial(tmp_path, {}), scenes=2, seed=3, physics=False, segmented=False
    )
    values = push_errors.summary(rows)
    (tmp_path / "p").mkdir()
    np.savez_compressed(tmp_path / "p" / "films.npz", **films)  # type: ignore[arg-type]
    metrics.write(tmp_path / "p", values, settings={})
    sources = page.Sources(prediction=tmp_path / "p", clears=[cleared[1]], runs=list(runs.values()))
    merged = page.write(tmp_path, sources)
    written = (tmp_path / "report.html").read_text()
    assert written.count("data:image/png;base64,") == 5
    assert "<h2>Networks</h2><table>" in written
    assert "74.4" in written, "the paper's numbers stand beside"
    assert 'src="http' not in written and "href=" not in written
    assert merged["clear/hard/dipn+gn/completion"] == metrics.read(cleared[1])["completion"]
    assert (
        json.loads((tmp_path / "metrics.json").read_text())["push_error/dipn/5cm/all"]
        == values["push_error/dipn/5cm/all"]
    )


NASTY = (r"$\frac{$ <script>alert(1)</script>", "\"'><img src=x onerror=y> {steps}", "price: $5$ \udcc3\udca4")
"""What users may call things: formulas that are none, markup, places of figures, bytes that are no text."""


class _Tags(html.parser.HTMLParser):
    """The tags of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.add(tag)
        assert tag != "img" or dict(attrs)["src"].startswith("data:image/png;base64,")  # type: ignore[union-attr]


def _renamed(folder: pathlib.Path, name: str) -> pathlib.Path:
    """Call the cases, the case file and the label of what was cleared `name`."""
    settings = files.read_json(folder / "settings.json")
    named = {"label": name, "tables.cases": f"my/{name.replace('/', '-')}.json"}
    files.write_json(folder / "settings.json", settings | named)
    entries = files.read_json(folder / "episodes.json", wanted=list)
    files.write_json(folder / "episodes.json", [entry | {"name": name, "ended": "fault"} for entry in entries])
    return folder


@pytest.fixture
def one_table(tmp_path: pathlib.Path) -> pathlib.Path:
    """Return the folder of an evaluation of one table."""
    (tmp_path / "one").mkdir()
    PARSERS["film"].prepare(tmp_path / "one")
    return tmp_path / "one"


@pytest.mark.parametrize("name", NASTY)
def test_what_users_named_is_text_in_pages_and_figures(
    name: str, one_table: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    folder = _renamed(one_table, name)
    run = tmp_path / name.replace("/", "-")
    run.mkdir()
    (run / "metrics.jsonl").write_text('{"step": 1, "loss": 1.0}\n')
    page.write(tmp_path, page.Sources(clears=[folder], runs=[run]))
    text = (tmp_path / "report.html").read_bytes().decode("utf-8")
    tags = _Tags()
    tags.feed(text)
    ours = {"html", "meta", "title", "style", "h1", "h2", "h3", "h4", "p", "table", "tr", "th", "td", "img"}
    assert tags.found == ours, "none of them comes from a name"
    assert "<h2>Networks</h2><table>" in text
    assert "intervals over cases, then over their repeats" in text, "as lockstep.summary computes them"
    assert text.count("data:image/png;base64,") == 4, "each figure stands in its place, once"


def test_two_folders_of_one_method_and_label_are_refused(one_table: pathlib.Path, tmp_path: pathlib.Path) -> None:
    other = pathlib.Path(shutil.copytree(one_table, tmp_path / "other"))
    with pytest.raises(UserError, match=r"both are gn on hard; give one of them, or clear again with another"):
        page.write(tmp_path / "o", page.Sources(clears=[one_table, other]))
    assert not (tmp_path / "o").exists()
    settings = files.read_json(other / "settings.json")
    files.write_json(other / "settings.json", settings | {"label": "again", "seed": 7})
    values = page.write(tmp_path / "o", page.Sources(clears=[one_table, other]), against="again")
    assert values["clear/hard/again/gn/grasps"] == values["clear/hard/gn/grasps"]
    written = (tmp_path / "o" / "report.html").read_text()
    assert "<p class=note>Rows of different tables: --seed not recorded (gn), 7 (gn (again)).</p>" in written
    assert "points from gn (again)</th>" in written and values["clear/hard/gn/efficiency_all_difference"] is None
    assert files.read_json(tmp_path / "o" / "metrics.json") == values
    assert (tmp_path / "o" / "table.md").read_text().count("| gn (again) |") == 1
    assert (tmp_path / "o" / "table.csv").read_text().count("here,hard,gn,again,") == 1
