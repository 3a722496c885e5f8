"""Every command of ours on a page does its work, made small: in the order of the page, in one folder."""

import functools
import importlib
import importlib.util
import os
import pathlib
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import page_commands
import pytest
from dipn_jax.eval.prediction import push_errors

from dipn_jax.commands import console
from dipn_jax.storage import accounting
from dipn_jax.system import files
from experiments import moving_picture, runs

ROOT = page_commands.ROOT
PAGES = [
    page
    for page in (*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")))
    if any(map(page_commands.ours, page_commands.commands(page)))
]
OFTEN = {"tutorial.md": "", "data_sets.md": "", "weights_elsewhere.md": "", "your_network.md": "results/hard"}
"""Pages that `make test-slow` tries, all of them or to the command that writes there; the others are tried by `make
test-pages`, and so is the rest of these."""
TRIED = [
    *(pytest.param(page, OFTEN[page.name], marks=pytest.mark.slow) for page in PAGES if page.name in OFTEN),
    *(pytest.param(page, "", marks=pytest.mark.pages) for page in PAGES if OFTEN.get(page.name) != ""),
]
MADE = {
    "tutorial.md": ("results/report/report.html",),
    "weights_elsewhere.md": ("exported/gn.safetensors", "exported/dipn.safetensors", "exported/vpg.safetensors"),
    "your_network.md": ("results/report.html", "exported/dipn", "exported/best", "runs/gn-online/config.json"),
    "cluster.md": ("results/hard/metrics.json", "results/curve/metrics.json"),
    "other_tools.md": ("exported/npz", "exported/hdf5", "exported/zarr", "exported/lerobot"),
}
"""What the commands of a page have made in the end, among other things."""


def work(words: list[str]) -> int:
    """Run a command and return its exit code: in this process, but one that starts Ray, in a process of its own."""
    if "ray" in words:
        settings = {"RAY_USAGE_STATS_ENABLED": "0"}
        return subprocess.run(in_a_process(words), env=os.environ | settings, check=False).returncode
    return console.run(words[0], importlib.import_module(runs.PROGRAMS[words[0]]).COMMANDS, words[1:])


def in_a_process(words: list[str]) -> list[str]:
    """Return the words that run a command in a process of its own."""
    return [sys.executable, "-m", runs.PROGRAMS[words[0]], *words[1:]]


def together(several: list[list[str]]) -> None:
    """Run the commands of a job of several processes, at the same time."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}"
    begun = []
    for words in several:
        words[words.index("--coordinator") + 1] = coordinator
        begun.append(subprocess.Popen(in_a_process(words)))
    assert [process.wait() for process in begun] == [0] * len(several), several


@pytest.mark.parametrize(("page", "last"), TRIED, ids=lambda given: given if isinstance(given, str) else given.name)
def test_the_commands_of_a_page_work_at_small_scale(
    page: pathlib.Path,
    last: str,
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(moving_picture, "PERIOD", 0.5)
    monkeypatch.setattr(moving_picture, "HOLD_FRAMES", 2)
    if page.name == "your_cases.md":
        (tmp_path / "my_cases.json").write_text(page_commands.block(page, "json"))
    job: list[list[str]] = []
    left_out: list[list[str]] = []
    for words in page_commands.commands(page):
        if job and "--coordinator" not in words:
            together(job)
            job = []
        if "experiments.moving_picture" in words:
            moving_picture.main(pathlib.Path("results/picture"), pathlib.Path("results/clearing.gif"))
        if not page_commands.ours(words):
            continue
        small = page_commands.smaller(words)
        if "ray" in words and importlib.util.find_spec("ray") is None:
            left_out.append(small)
            continue
        for place in page_commands.is_read(small):
            before = page_commands.stand_in(place, data)
            assert before is None or work(page_commands.smaller(before)) == 0
        if "--coordinator" in words:
            job.append(small)
        else:
            assert work(small) == 0, (words, small)
        if last and words[-1] == last:
            break
    assert not job, "another command comes after those of a job"
    for name in MADE.get(page.name, ()) if not last else (last,):
        assert pathlib.Path(name).exists(), name
    if page.name == "tutorial.md":
        assert pathlib.Path("results/clearing.gif").stat().st_size < 1.5e6
    elif page.name == "your_network.md":
        assert files.read_json(pathlib.Path("results/hard/metrics.json"))["instances"] == 1
    elif page.name == "sweep_distance.md":
        assert files.read_json(pathlib.Path("data/sweep/config.json"))["distances"] == [0.03, 0.06, 0.1]
    if left_out:
        pytest.skip(f"Ray is not installed, the others pass: {'; '.join(map(shlex.join, left_out))}")


TO_SHARE: dict[str, Callable[[dict[str, Any]], int]] = {
    "clear": lambda given: given["tables"].count(),
    "sweep": lambda given: given["tables"].count(),
    "grasp": lambda given: given["scenes_"],
    "prediction": lambda given: push_errors.groups(given["scenes_"]),
}
"""What the workers of an evaluation share, by its options."""


def asked(words: list[str]) -> dict[str, Any]:
    """Return the options of a command of ours by name, as its function would get them; the command is not run."""
    found: dict[str, Any] = {}

    def stub(command: Callable[..., Any]) -> Callable[..., Any]:
        return functools.wraps(command)(lambda **given: found.update(given))

    known = importlib.import_module(runs.PROGRAMS[words[0]]).COMMANDS
    assert console.run(words[0], {name: stub(command) for name, command in known.items()}, words[1:]) == 0, words
    return found


def test_no_job_of_a_page_has_more_workers_than_work() -> None:
    """As pages have them, before they are made small."""
    seen = 0
    for page in PAGES:
        for words in filter(page_commands.ours, page_commands.commands(page)):
            if "--of" in words:
                given = asked(words)
                if words[0] == "dipn-datagen":
                    of = given["work"].of
                    there = accounting.RequestedSize(given["episodes"], given["shard_size"]).shards()
                else:
                    of, there = given["share"].of, TO_SHARE[words[1]](given)
                assert 1 < of <= there, words
                seen += 1
    assert seen >= 6


def test_every_option_of_a_page_is_kept_or_made_smaller() -> None:
    """The commands that are run are those of the page: the same options, in the same order, but for values."""
    for page in PAGES:
        for words in filter(page_commands.ours, page_commands.commands(page)):
            given = [word for word in words if word.startswith("--")]
            small = [word for word in page_commands.smaller(words) if word.startswith("--")]
            assert [word for word in small if word in given] == given, words
