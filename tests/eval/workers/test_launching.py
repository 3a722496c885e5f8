"""Evaluations whose parts are tasks end as those of one worker, whatever is lost meanwhile."""

import importlib.util
import pathlib
from collections.abc import Iterator
from typing import Any

import pytest
from dipn_jax.eval import cli
from dipn_jax.eval.workers import launching

from dipn_jax.commands import console, launch
from dipn_jax.commands.launch import Launch
from dipn_jax.errors import UserError

WORDS = ("clear", "--method", "gn", "--cases", "random", "--objects", "1", "--instances", "3", "--aids")
"""A small evaluation."""


def _run(out: pathlib.Path, network: pathlib.Path, *words: str) -> int:
    options = ["--grasp-net", str(network), "--engine", "native", "--out", str(out), *words]
    return console.run("test", cli.COMMANDS, [*WORDS, *options])


@pytest.fixture
def parts_of_one(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let tasks be called here, each twice, as one is whose worker is lost at its end; return their numbers."""
    called: list[int] = []

    def run(function: Any, tasks: Any, *, launch: Launch) -> Iterator[tuple[int, Any]]:
        for number, task in enumerate(tasks):
            function(*task)
            called.append(task[1]["share"].shard)
            yield number, function(*task)

    monkeypatch.setattr(launch, "run", run)
    return called


@pytest.mark.slow
def test_tasks_make_the_evaluation_of_one_worker_and_a_second_start_only_what_is_missing(
    parts_of_one: list[int],
    tiny: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out, net, ray = tmp_path / "out", tiny["grasp"], ("--launcher", "ray", "--of", "3")
    assert _run(tmp_path / "alone", net) == 0
    make = launching.make_part

    def stopped(kind: str, given: dict[str, Any]) -> None:
        if given["share"].shard == 1:
            (out / "parts" / ".00001-of-00003.1-abc.tmp").mkdir()  # of a task that is lost
            raise KeyboardInterrupt
        make(kind, given)

    with monkeypatch.context() as patch:
        patch.setattr(launching, "make_part", stopped)
        assert _run(out, net, *ray) == 130
    assert parts_of_one == [0] and not (out / "metrics.json").exists()
    assert _run(out, net, *ray, "--num-cpus", "2") == 0
    assert parts_of_one == [0, 1, 2]
    for name in ("metrics.json", "episodes.json", "episodes/002.npz"):
        assert (out / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    assert sorted(path.name for path in (out / "parts").iterdir()) == [f"{i:05d}-of-00003" for i in range(3)]
    assert not (out / "owner.json").exists()
    capfd.readouterr()
    assert _run(out, net, *ray, "--seed", "7") == 2
    assert "holds another part of an evaluation" in capfd.readouterr().err and parts_of_one == [0, 1, 2]


def test_a_mistake_of_the_users_in_a_task_is_one_line(
    parts_of_one: list[int],
    tiny: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def mistaken(*_: Any) -> None:
        raise UserError("checkpoint runs/gn: no such folder")

    monkeypatch.setattr(launching, "make_part", mistaken)
    assert _run(tmp_path / "out", tiny["grasp"], "--launcher", "ray", "--of", "3") == 2
    said = capfd.readouterr().err
    assert "error: checkpoint runs/gn: no such folder" in said and "Traceback" not in said
    assert _run(tmp_path / "out", tiny["grasp"], "--launcher", "ray") == 2
    assert "--launcher ray makes all shards: give --of" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "most"),
    [
        (("clear", "--method", "gn", "--grasp-net", "grasp", "--instances", "2"), 20),
        (("clear", "--method", "gn", "--grasp-net", "grasp", "--names", "01", "06"), 2),
        (("clear", "--method", "gn", "--grasp-net", "grasp", "--cases", "random", "--instances", "3"), 3),
        (("sweep", "--push-net", "dipn", "--grasp-net", "grasp", "--pushes", "0"), 10),
        (("grasp", "--grasp-net", "grasp", "--scenes", "5"), 5),
        (("prediction", "--push-net", "dipn", "--scenes", "129"), 3),
    ],
    ids=lambda given: "-".join(given[::4]) if isinstance(given, tuple) else str(given),
)
def test_more_parts_than_can_be_shared_are_refused_before_anything_is_launched(
    words: tuple[str, ...],
    most: int,
    tiny: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    begun: list[int] = []

    def run(_: Any, tasks: Any, **__: Any) -> Iterator[Any]:
        begun.append(len(tasks))
        yield from ()

    monkeypatch.setattr(launch, "run", run)
    out = tmp_path / "out"
    for of in (most + 1, most):
        given = [str(tiny.get(word, word)) for word in words[1:]]
        options = ["--launcher", "ray", "--of", str(of), "--out", str(out)]
        assert console.run("test", cli.COMMANDS, [words[0], *given, *options]) == 2
        said = capfd.readouterr().err
        if of > most:
            assert f"--of {of}: more workers than the {most} that can be shared" in said and not out.exists()
    assert begun == [most] and "no part of an evaluation" in said, "the parts that nobody made"


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install '.[ray]'")
def test_a_cluster_that_loses_nodes_makes_the_evaluation_of_one_machine(
    tiny: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node is removed and workers are killed when the first part is there."""
    import ray_cluster

    lost: list[int] = []
    assert _run(tmp_path / "alone", tiny["grasp"]) == 0
    with ray_cluster.of_nodes(3) as cluster:
        monkeypatch.setattr(launch, "run", ray_cluster.losing(cluster, launch.run, lost))
        assert _run(tmp_path / "out", tiny["grasp"], "--launcher", "ray", "--of", "3") == 0
    assert lost and lost[0] >= 1
    for name in ("metrics.json", "episodes.json", "episodes/002.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
