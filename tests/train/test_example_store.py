"""Examples that are kept in files: the same ones, each made once, taken up again only if they were closed."""

import pathlib
import shutil
import signal
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.train import cli
from dipn_jax.train.example_store import ExampleStore
from dipn_jax.train.grasp import GraspTask
from dipn_jax.train.push import PushTask

from dipn_jax import batching
from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage.space import FREE_DISK_BYTES, Space
from dipn_jax.system import machine


class Maker:
    """Makes examples of numbers, and notes which."""

    def __init__(self) -> None:
        self.made: list[int] = []

    def __call__(self, index: np.ndarray) -> dict[str, np.ndarray]:
        assert len(index) % batching.SMALL_BATCH == 0, "few shapes are compiled"
        self.made += sorted(set(index.tolist()))
        return {"square": (index**2).astype(np.float32), "row": np.stack([index, -index], 1)}


def _store(folder: pathlib.Path, about: str = "squares") -> tuple[ExampleStore, Maker]:
    maker = Maker()
    return ExampleStore(maker, 100, space=Space(0, folder), about=about), maker


def _check(store: ExampleStore, index: list[int]) -> None:
    found = store.take(np.array(index))
    np.testing.assert_array_equal(found["square"], np.square(index))
    np.testing.assert_array_equal(found["row"], np.stack([index, np.negative(index)], 1))
    assert found["square"].dtype == np.float32


def test_each_example_is_made_once_and_the_right_one_is_returned(tmp_path: pathlib.Path) -> None:
    store, maker = _store(tmp_path / "s")
    _check(store, [7, 3, 7, 99])
    del maker.made[:]
    _check(store, [3, 5, 99])
    assert maker.made == [5]
    _check(store, list(range(100)))
    assert sorted(maker.made) == sorted({*range(100)} - {3, 7, 99})


def test_a_disk_that_is_nearly_full_is_one_line(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, _ = _store(tmp_path / "s")
    _check(store, [1])
    full = shutil.disk_usage(tmp_path)._replace(free=int(FREE_DISK_BYTES))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    with pytest.raises(UserError, match=r"100\.0 MB are free, and more examples need 0\.0 MB and some to spare; make"):
        store.take(np.array([2]))
    _check(store, [1])


def test_what_was_closed_is_taken_up_and_nothing_else(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine, "boot_id", lambda: None)
    store, _ = _store(tmp_path / "s")
    _check(store, [1, 2])
    store.close()
    assert "GB of examples are kept there" in capsys.readouterr().out
    again, maker = _store(tmp_path / "s")
    _check(again, [2, 1])
    assert maker.made == [2], "one, to see shapes"
    cut, maker = _store(tmp_path / "s")  # `again` was not closed
    _check(cut, [1, 2])
    assert set(maker.made) == {1, 2}
    cut.close()
    other, maker = _store(tmp_path / "s", about="other squares")
    _check(other, [1, 2])
    assert set(maker.made) == {1, 2}


KILLED = """
import os, pathlib, signal, sys
import numpy as np
from dipn_jax.storage.space import Space
from dipn_jax.train.example_store import ExampleStore

def make(index):
    return {"square": (index**2).astype(np.float32), "row": np.stack([index, -index], 1)}

store = ExampleStore(make, 100, space=Space(0, pathlib.Path(sys.argv[1])), about="squares")
store.take(np.array([1, 2, 70]))
os.kill(os.getpid(), signal.SIGKILL)
"""
"""A process that makes three examples and is killed."""


@pytest.mark.skipif(machine.boot_id() is None, reason="this system does not tell its starts apart")
def test_what_a_killed_process_made_is_used_unless_the_machine_was_started_since(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for boot, made in (machine.boot_id(), [1, 5]), ("another", [1, 2, 5, 70]):
        killed = subprocess.run(
            [sys.executable, "-c", KILLED, str(tmp_path / "s")], check=False, stdout=subprocess.PIPE
        )
        assert killed.returncode == -signal.SIGKILL
        monkeypatch.setattr(machine, "boot_id", lambda boot=boot: boot)
        store, maker = _store(tmp_path / "s")
        _check(store, [1, 2, 5, 70])
        assert sorted(set(maker.made)) == made, "the first one is made in any case, to see shapes"
        shutil.rmtree(tmp_path / "s")


@pytest.mark.parametrize(("count", "size"), [(1, [16]), (16, [16]), (17, [32]), (32, [32]), (33, [64]), (65, [64, 16])])
def test_few_sizes_of_batches_are_made(count: int, size: list[int]) -> None:
    sizes: list[int] = []

    def make(index: np.ndarray) -> np.ndarray:
        sizes.append(len(index))
        return index

    ExampleStore(make, 100, space=Space(), about="numbers").take(np.arange(count))
    assert sizes == [size[0], *size], "one, to see shapes, by the program that makes the first; and then all"


@pytest.mark.parametrize("memory", [0.00001, 1.0])
def test_examples_are_in_files_only_if_they_are_large(memory: float, tmp_path: pathlib.Path) -> None:
    maker = Maker()
    store = ExampleStore(maker, 5000, space=Space(memory, tmp_path / "s"), about="squares")
    for _ in range(2):
        np.testing.assert_array_equal(store.take(np.array([4, 4000]))["square"], [16, 16_000_000])
    assert sorted(maker.made) == [4, 4, 4000], "those that are taken, once, and one to see shapes"
    store.close()
    assert (tmp_path / "s").exists() == (memory < 0.001)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["push", "grasp"])
def test_tasks_learn_from_the_same_examples(kind: str, data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    def task(**space: Any) -> Any:
        if kind == "push":
            return PushTask(data["push"], DipnConfig(width=8), limit=None, centimetres=(5, 10), **space)
        return GraspTask(data["grasp"], GraspConfig(width=8), **space)

    large = task(space=Space(0, tmp_path / "s"))
    index = np.array([3, 0, 17, 3])
    stored, kept = large.fetch(index), task().fetch(index)
    large.close()
    assert (tmp_path / "s" / "state.json").exists()
    for one, other in zip(jax.tree.leaves(stored), jax.tree.leaves(kept), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_the_command_keeps_them_beside_the_run_and_closes_them(
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fit(task: Any, *_: Any, **__: Any) -> None:
        task.fetch(np.array([1]))

    monkeypatch.setattr(cli, "_fit", fit)
    for extra, wanted in ((), False), (("--memory", "0"), True), (("--compile-only",), False):
        out = tmp_path / "-".join(("run", *extra))
        words = ["grasp", "--data", str(data["grasp"]), "--out", str(out), *extra]
        assert console.run("test", cli.COMMANDS, words) == 0
        assert (out / "examples" / "0" / "state.json").exists() == wanted
        said = capsys.readouterr().out
        assert ("of episodes are kept" in said) == ("--memory" in extra)
        assert ("of examples are kept" in said) == ("--memory" in extra)
    monkeypatch.setattr(jax, "process_index", lambda: 3)  # as where a job manager has started several
    words = ["grasp", "--data", str(data["grasp"]), "--out", str(tmp_path / "several"), "--memory", "0"]
    assert console.run("test", cli.COMMANDS, words) == 0
    assert [path.name for path in (tmp_path / "several" / "examples").iterdir()] == ["3"]
