"""The pages of results show the figures in docs, and are written from the results of runs."""

import pathlib
import shutil
from types import ModuleType
from typing import Any

import pytest

from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments import clearing, clearing_tables, demo, grasping, mjx_elliptic_cone, pages, push_prediction, runs

DOCS = pathlib.Path(__file__).parent.parent.parent / "docs"
PAGES = {"push-prediction": push_prediction, "grasping": grasping, "clearing": clearing, "demo": demo}


def _figures(name: str) -> dict[str, Any]:
    """The numbers of a page's JSON, without how they were made."""
    return {key: value for key, value in files.read_json(DOCS / f"{name}.json").items() if key != pages.MADE}


@pytest.mark.parametrize("name", [*PAGES, "world", "mjx-elliptic-cone"])
def test_the_boxes_in_docs_are_those_of_the_kept_facts(name: str) -> None:
    text, values = (DOCS / f"{name}.md").read_text(), files.read_json(DOCS / f"{name}.json")
    assert values[pages.MADE] and all(
        each["processor"] for run in values[pages.MADE].values() for each in run["made_by"]
    )
    box = pages.box(values)
    assert pages.with_box(text, box) == text
    assert not any(line.endswith(f": {runs.NOT_RECORDED}") for line in box.splitlines())


@pytest.mark.parametrize("name", PAGES)
def test_the_pages_in_docs_show_the_figures_in_docs(name: str) -> None:
    page: ModuleType = PAGES[name]
    text, values = (DOCS / f"{name}.md").read_text(), files.read_json(DOCS / f"{name}.json")
    if page is clearing:
        assert pages.with_tables(text, clearing_tables.section(values)) == text
        tables = [clearing_tables.swept(files.read_json(DOCS / "sweep.json"))]
    else:
        tables = page.tables(values)
    for table in tables:
        assert table in text and pages.with_table(text, table) == text


def test_the_elliptic_cones_page_shows_its_figures() -> None:
    values = files.read_json(DOCS / "mjx-elliptic-cone.json")
    table = mjx_elliptic_cone.table(values)
    assert table in (DOCS / "mjx-elliptic-cone.md").read_text()
    assert values["MuJoCo C/not_a_number"] == 0 and len(table.splitlines()) == 5


FACTS = {
    "data": {"made_by": [{"commit": "abc", "processor": "A", "cores": 2}], "seed": 0, "versions": {"jax": "1.0"}},
    "runs/1": {"made_by": [{"commit": "abc", "processor": "A", "cores": 2}], "seed": 1, "versions": {"jax": "1.0"}},
    "curve": {
        "made_by": [{"commit": "abc", "processor": "A", "cores": 2}, {"commit": "def", "processor": "B", "cores": 4}],
        "seed": 1_000_000,
        "versions": {"jax": "1.0", "mujoco": "3.0"},
    },
    "report": {"made_by": [{"commit": "abc", "processor": "A", "cores": 2}], "seed": None, "versions": {"jax": "1.0"}},
    "old": {},
    "last": {"made_by": [{"commit": "abc", "processor": "A", "cores": 2}], "seed": 0, "versions": {"jax": "1.0"}},
}


def test_a_box_lists_machines_and_commits_and_what_is_not_recorded() -> None:
    assert pages.box({"a": 1, "b": 2, "made": FACTS}) == (
        "```\n"
        "figures: 2\n"
        "machine: A, 2 cores and B, 4 cores (curve); not recorded (old); A, 2 cores (all others)\n"
        "commit: abc and def (curve); not recorded (old); abc (all others)\n"
        "versions: jax 1.0, mujoco 3.0 (curve); not recorded (old); jax 1.0 (all others)\n"
        "seed: 1 (runs/1); 1,000,000 (curve); none (report); not recorded (old); 0 (all others)\n"
        "```\n"
    )
    several = {"networks": {**FACTS["data"], "seed": [0, 1, 2]}, "evaluations": {**FACTS["data"], "seed": 1_000_000}}
    assert "seed: 0, 1, 2 (networks); 1,000,000 (evaluations)\n" in pages.box({"made": several})
    alike = pages.box({"made": {name: FACTS["data"] for name in ("data", "x")}})
    assert "machine: A, 2 cores\ncommit: abc\n" in alike
    unknown = pages.box({f"figure-{i}": 0.0 for i in range(1200)})
    assert "figures: 1,200\nmachine: not recorded\ncommit: not recorded\n" in unknown


def test_long_lines_of_a_box_are_folded() -> None:
    many = {f"runs/{i}-0": {"made_by": [{"commit": f"{i % 9}" * 12, "processor": "A", "cores": 2}]} for i in range(40)}
    lines = pages.box({"made": many}).splitlines()
    assert max(map(len, lines)) <= pages.BOX_WIDTH and len(lines) > 8


def test_a_table_and_a_box_have_one_place() -> None:
    table = "| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    longer = table + "| 3 | 4 |\n"
    assert pages.with_table(f"x\n\n{table}\ny\n", longer) == f"x\n\n{longer}\ny\n"
    assert pages.with_table(f"x\n\n{longer}", table) == f"x\n\n{table}"
    for text in ("x\n", table + "\n" + table):
        with pytest.raises(UserError, match="one table"):
            pages.with_table(text, table)
    empty = f"x\n{pages.BOX_BEGINS}\n{pages.BOX_ENDS}\ny\n"
    full = pages.with_box(empty, "box\n")
    assert full == f"x\n{pages.BOX_BEGINS}\nbox\n{pages.BOX_ENDS}\ny\n" and pages.with_box(full, "box\n") == full
    with pytest.raises(UserError, match="no place for its box"):
        pages.with_box("x\n", "box\n")


@pytest.fixture
def docs(tmp_path: pathlib.Path) -> pathlib.Path:
    """Return a copy of the pages to write to, without their figures."""
    copy = tmp_path / "docs"
    copy.mkdir()
    for name in PAGES:
        shutil.copy(DOCS / f"{name}.md", copy)
    return copy


def _put(folder: pathlib.Path, metrics: dict[str, Any], *pictures: str) -> None:
    files.write_json(folder / "metrics.json", metrics)
    for name in pictures:
        (folder / name).write_bytes(b"picture of " + name.encode())


def _under(values: dict[str, Any], name: str) -> dict[str, Any]:
    return {key.removeprefix(f"{name}/"): value for key, value in values.items() if key.startswith(f"{name}/")}


def _unchanged(docs: pathlib.Path, name: str, values: dict[str, Any]) -> None:
    """Check that only the box of a page has changed, and in its JSON only how it was made."""
    written = files.read_json(docs / f"{name}.json")
    made = written.pop("made")
    assert written == values
    assert set(made) == {run.name for run in PAGES[name].list_runs(docs.parent)}
    expected = pages.with_box((DOCS / f"{name}.md").read_text(), pages.box({**values, "made": made}))
    assert (docs / f"{name}.md").read_text() == expected


def test_the_page_of_push_prediction_is_written(docs: pathlib.Path) -> None:
    values = _figures("push-prediction")
    root = docs.parent
    listed = push_prediction.list_runs(root)
    folders = {key.partition("/")[0] for key in values} & {run.name for run in listed}
    own = {key: value for key, value in values.items() if key.partition("/")[0] not in folders}
    _put(root / "push" / "curve", own, "curve-all.png", "curve-moved.png")
    for name in folders:
        _put(root / "push" / name, _under(values, name))
    runs.write_stamp(listed[0], "key", complete=True)
    push_prediction.write_page(root, docs=docs)
    _unchanged(docs, "push-prediction", values)
    assert (docs / "push-prediction-moved.png").read_bytes() == b"picture of curve-moved.png"
    assert files.read_json(docs / "push-prediction.json")["made"]["data"]["made_by"][0]["cores"] >= 1


def test_the_page_of_grasping_is_written(docs: pathlib.Path) -> None:
    values = _figures("grasping")
    own = {key: value for key, value in values.items() if key.startswith("online/")}
    results = docs.parent / "grasp"
    _put(results / "online", own, "curve.png")
    for name in grasping.ROWS:
        _put(results / name, _under(values, name), "reliability.png")
    grasping.write_page(docs.parent, docs=docs)
    _unchanged(docs, "grasping", values)
    assert (docs / "grasping-reliability.png").read_bytes() == b"picture of reliability.png"


def test_the_page_of_clearing_is_what_is_kept(docs: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(docs.parent)
    root = pathlib.Path("results")
    values, sweep = files.read_json(DOCS / "clearing.json"), files.read_json(DOCS / "sweep.json")
    for name in ("clearing-tables.json", "sweep.json", "push-or-grasp.json"):
        shutil.copy(DOCS / name, docs)
    clearing.write_page(root, docs=docs)
    written = files.read_json(docs / "clearing.json")
    assert written.keys() == values.keys() and written[pages.MADE] == values[pages.MADE]
    for key in values.keys() - {pages.MADE}:
        assert written[key] == pytest.approx(values[key]), key
    assert (docs / "clearing.md").read_text() == (DOCS / "clearing.md").read_text()
    numbers = {key: value for key, value in sweep.items() if key != pages.MADE}
    _put(root / "clear" / "sweep", {**numbers, "other": 1}, "sweep.png")
    files.write_json(
        root / "clear" / "sweep" / runs.STAMP, {"command": "", "key": "", "complete": True, **sweep["made"]}
    )
    clearing.write_page(root, docs=docs)
    assert files.read_json(docs / "sweep.json") == sweep


def test_the_page_of_the_demo_is_written_only_on_request(
    docs: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo.write_page, "__kwdefaults__", {"docs": docs})
    root, before = docs.parent / "demo", (docs / "demo.md").read_text()
    assert demo.main(["--page", "--out", str(root)]) == 2
    assert "no such file" in capsys.readouterr().err and not (docs / "demo.json").exists()
    values = _figures("demo")
    _put(root, values)
    for run in demo.list_runs(root):
        runs.write_stamp(run, runs.keys(demo.list_runs(root))[run.name], complete=True)
    assert demo.main(["--out", str(root)]) == 0
    assert (docs / "demo.md").read_text() == before and not (docs / "demo.json").exists()
    assert demo.main(["--page", "--out", str(root)]) == 0
    written = files.read_json(docs / "demo.json")
    made = written.pop("made")
    assert written == values and set(made) == {run.name for run in demo.list_runs(root)}
    expected = pages.with_box(before, pages.box({**values, "made": made}))
    assert (docs / "demo.md").read_text() == expected
