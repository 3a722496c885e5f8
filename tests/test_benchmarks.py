"""The benchmarks' command line, and the page of figures in docs. What the benchmarks measure is not tested."""

import json
import pathlib

import pytest

from benchmarks import __main__ as command
from benchmarks import on_gpu, page, scaling

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
    known = command.BENCHMARKS if name == "benchmarks" else on_gpu.STAGES
    assert page.headline(kept["figures"], known) in " ".join(text.split())


def test_figures_that_miss_their_goals_are_named() -> None:
    figures = {
        "render.vs_raycast": 20.0,
        "train.saving": 1.04,
        "train.saving/in_line": 9.0,  # has no goal, and neither has the next
        "drops.cheaper/p_height/7": 0.5,
        "push_net.vs_torch/paper": 0.5,
        "push_net.vs_torch/paper_memory": 0.5,
        "rates.mjx/push/7": 1.0,
    }
    said = "1 of 3 figures with a goal reach it. Missed: `train.saving` (1.04, goal <= 1.03), `push_net.vs_torch/paper`"
    known = (
        "render.vs_raycast",
        "train.saving",
        "drops.cheaper",
        "storage.vs_images",
        "jobs.overhead",
    )  # the last one has no goal
    assert page.headline(figures, known) == f"{said} (0.5, goal >= 1). Not measured: `storage.vs_images`."
    said = "1 of 1 figures with a goal reach it. Missed: none. Not measured: none."
    assert page.headline({"render.vs_raycast": 20.0}, known[:1]) == said


def test_the_page_of_large_data_sets_shows_the_figures_in_docs() -> None:
    kept, text = json.loads((DOCS / "scaling.json").read_text()), (DOCS / "scaling.md").read_text()
    for table in (scaling.costs(kept), scaling.overheads(kept), page.origins(kept)):
        assert table in text
    hours = kept["machine"][0]["cores"] * scaling.MILLION / kept["figures"]["rates.native/push/7"] / 3600
    assert f"A million pushes of seven objects cost {hours:.1f} core-hours" in text
    fast = json.loads((DOCS / "benchmarks.json").read_text())["figures"]
    written, read = fast["datagen.encoding"], fast["datagen.encoding/read"]
    at = " ".join(text.split())
    assert f"write {round(written, -4):,.0f} pushes" in at and f"reads {round(read, -4):,.0f} a second" in at
    assert f"a million in {1e6 / read:.0f} s" in at
    one, key = [f"{fast[f'train.first_step/{what}']:.0f}" for what in ("seconds", "seconds_in_files")], "megabytes"
    size, small = (f"{fast[f'train.first_step/{key}{end}'] / 1000:.1f} GB" for end in ("", "_in_files"))
    assert f"takes {one[0]} s and {size} of memory, and with `--memory 0.1` {one[1]} s and {small}" in at
    first = [f"{fast[f'train.first_step/seconds_to_step{end}']:.0f} s" for end in ("", "_in_files")]
    assert f"its first step is over after {' and '.join(first)}" in at
    gpu = json.loads((DOCS / "benchmarks-h200.json").read_text())
    cores = gpu["machine"]["cores"]
    most = {
        engine: max(value for name, value in gpu["figures"].items() if f"scene_seconds/{engine}/" in name)
        for engine in ("mjx", "native")
    }
    worth = most["mjx"] / (most["native"] / cores)
    assert f"as much as {worth:.1f} cores of its host" in at
    assert f"one such GPU {hours / worth:.1f} h, and the host's {cores} cores {hours / cores:.1f} h" in at
    assert f"takes its driver {kept['figures']['jobs.overhead/launch_milliseconds']:.2g} ms" in text


def test_costs_are_of_a_core_and_fall_with_their_number() -> None:
    kept = {
        "machine": {"cores": 2},
        "figures": {"rates.native/push/7": 100.0, "jobs.overhead/ray/1000/milliseconds": 3.0},
    }
    # 10,000 s of two cores; 10,000 cores make 500,000 a second, in shards of 500
    assert "| push | 7 | 100 | 5.56 | 0.056 h | 10 s | 1e+03 |" in scaling.costs(kept)
