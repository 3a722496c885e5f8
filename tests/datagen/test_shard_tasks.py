"""Shards as tasks are the shards of one machine, whatever is lost meanwhile."""

import dataclasses
import importlib.util
import os
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
from dipn_jax.datagen import cli, generate, shard_tasks
from dipn_jax.datagen.generate import Job

from dipn_jax.commands import console, launch
from dipn_jax.commands.launch import Launch
from dipn_jax.errors import UserError
from dipn_jax.storage import records
from dipn_jax.world import scenes

JOB = Job(kind="images", scene=scenes.fixed_count(1), episodes=6, seed=0, shard_size=1, actions=1, engine="native")
WORDS = ("images", "--objects", "1", "--episodes", "6", "--shard-size", "1", "--engine", "native")


def _bytes(folder: pathlib.Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*") if path.name != "asked.json"}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the data set as one machine makes it."""
    out = tmp_path_factory.mktemp("alone")
    generate.generate(JOB, out)
    return out


def test_tasks_make_the_data_set_of_one_machine(
    alone: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With tasks that are called here, each twice, as one is whose worker is lost when it has written."""

    def run(function: Any, tasks: Any, *, launch: Launch) -> Iterator[tuple[int, Any]]:
        for number, task in reversed(list(enumerate(tasks))):
            assert function(*task) == function(*task)
            yield number, function(*task)

    monkeypatch.setattr(launch, "run", run)
    out = tmp_path / "out"
    generate.generate(JOB, out, elsewhere=shard_tasks.elsewhere(Launch("ray"), threads=None, network=None))
    assert _bytes(out) == _bytes(alone)


def test_a_task_refuses_what_it_cannot_make(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match="a task does not see it; give an --out that all machines"):
        shard_tasks.make_shard(JOB, JOB.describe(), 0, tmp_path / "nowhere", 1, None)
    job = dataclasses.replace(JOB, engine="mjx")
    with pytest.raises(UserError, match="begun with cuda, a task has cpu"):
        shard_tasks.make_shard(job, job.describe() | {"device": "cuda"}, 0, tmp_path, 1, None)
    with pytest.raises(UserError, match="a task finds other weights there"):
        shard_tasks._scorer(pathlib.Path("builtin"), "0")


def test_a_cluster_makes_all_shards_and_no_worker_has_a_number(capfd: pytest.CaptureFixture[str]) -> None:
    words = [*WORDS, "--out", "x", "--launcher", "ray", "--shard", "1", "--of", "2"]
    assert console.run("test", cli.COMMANDS, words) == 2
    assert "--launcher ray makes all shards: leave out --shard and --of" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install '.[ray]'")
def test_nodes_and_workers_that_are_lost_change_nothing(
    alone: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In the middle a node is removed and workers are killed; then the command is given again, with shards missing."""
    import ray_cluster

    lost: list[int] = []
    out = tmp_path / "out"
    words = [*WORDS, "--out", str(out), "--launcher", "ray"]
    with ray_cluster.of_nodes(3) as cluster:
        monkeypatch.setattr(launch, "run", ray_cluster.losing(cluster, launch.run, lost))
        assert console.run("test", cli.COMMANDS, words) == 0
        assert lost and lost[0] >= 1
        assert _bytes(out) == _bytes(alone) and records.missing(out) is None
        kept = {path: path.stat().st_mtime_ns for path in sorted(out.glob("*.parquet"))[2:]}
        for path in sorted(out.glob("*.parquet"))[:2]:
            path.unlink()
        assert console.run("test", cli.COMMANDS, words) == 0
        assert _bytes(out) == _bytes(alone) and {path: path.stat().st_mtime_ns for path in kept} == kept
        (out / "shard-00001.parquet").write_bytes(b"")
        assert console.run("test", cli.COMMANDS, words) == 2
        assert "shard-00001.parquet" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install '.[ray]'")
def test_a_driver_that_is_killed_goes_on_when_it_is_started_again(alone: pathlib.Path, tmp_path: pathlib.Path) -> None:
    """The process that hands out the tasks is killed as soon as it has a shard; the next makes only what is missing."""
    import ray_cluster

    out = tmp_path / "out"
    words = [*WORDS, "--out", str(out), "--launcher", "ray"]
    with ray_cluster.of_nodes(2) as cluster:
        environment = os.environ | {"RAY_ADDRESS": cluster.address}
        driver = subprocess.Popen([sys.executable, "-m", "dipn_jax.datagen.cli", *words], env=environment)
        while not (there := list(out.glob("*.parquet"))) and driver.poll() is None:
            time.sleep(0.05)
        driver.kill()
        assert driver.wait() == -signal.SIGKILL, "it was killed before it had ended"
        assert 0 < len(there) < 6 and not (out / "manifest.json").exists()
        kept = {path: path.stat().st_mtime_ns for path in there}
        assert console.run("test", cli.COMMANDS, words) == 0
    assert _bytes(out) == _bytes(alone) and {path: path.stat().st_mtime_ns for path in kept} == kept
