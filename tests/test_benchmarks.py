"""The benchmarks' command line, and the page of figures in docs. What the benchmarks measure is not tested."""

import json
import pathlib

import pytest

from benchmarks import __main__ as command
from benchmarks import page

DOCS = pathlib.Path(__file__).parent.parent / "docs"


def test_without_a_name_all_are_listed_with_their_goals(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in command.BENCHMARKS) and ">= 0.90" in said


def test_an_unknown_name_gets_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["rocket"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: benchmark rocket: no such name") and error.count("\n") == 1


def test_every_benchmark_can_be_loaded() -> None:
    for benchmark in command.BENCHMARKS.values():
        assert callable(benchmark.load())


@pytest.mark.parametrize("name", ["benchmarks", "benchmarks-h200"])
def test_the_page_in_docs_shows_the_figures_in_docs(name: str) -> None:
    kept = json.loads((DOCS / f"{name}.json").read_text())
    text = (DOCS / "benchmarks.md").read_text()
    for table in page.tables(kept["figures"]).strip().split("\n\n"):
        assert table in text
    assert page.origins(kept) in text
