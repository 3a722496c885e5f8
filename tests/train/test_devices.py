"""Batches shared by devices and processes: what is learnt is what one device learns, but for rounding."""

import os
import pathlib
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest
from dipn_jax.train import cli, devices
from dipn_jax.train.configs import Compute, TrainConfig
from dipn_jax.train.loop import fit
from dipn_jax.train.push import PushTask

from dipn_jax import console, files
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig

CONFIG = DipnConfig(width=8)
WHOLE = TrainConfig(steps=4, batch=4, optimizer="sgd", eval_every=1, save_every=2)
SCRIPT = """
import pathlib, sys
from dipn_jax import console
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.train import devices
from dipn_jax.train.configs import Compute, TrainConfig

data, out, coordinator, processes, process = sys.argv[1:]
console.enable_compilation_cache()
compute = Compute(data_parallel=True, coordinator=coordinator, processes=int(processes), process=int(process))
devices.join(compute)

import jax
from dipn_jax.train.loop import fit
from dipn_jax.train.push import PushTask

assert jax.device_count() == 4 and jax.local_device_count() == 4 // int(processes)
task = PushTask(pathlib.Path(data), DipnConfig(width=8), limit=None, centimetres=(5, 10))
half = TrainConfig(steps=2, batch=4, optimizer="sgd", eval_every=1, save_every=2)
fit(task, half, pathlib.Path(out), compute=compute)
"""
"""Two steps of DIPN by four devices."""


def _start(data: pathlib.Path, out: pathlib.Path, *, processes: int) -> None:
    """Run the script in so many processes, which have four devices together."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}" if processes > 1 else ""
    flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={4 // processes}", "JAX_PLATFORMS": "cpu"}
    words = [sys.executable, "-c", SCRIPT, str(data), str(out), coordinator, str(processes)]
    going = [
        subprocess.Popen([*words, str(each)], env=os.environ | flags, stderr=subprocess.PIPE, text=True)
        for each in range(processes)
    ]
    said = [process.communicate(timeout=300)[1] for process in going]
    assert [process.returncode for process in going] == [0] * processes, said[0][-3000:]
    assert sum("train dipn: 2/2 steps" in each for each in said) == 1, "one of them says how far the run is"


@pytest.fixture(scope="module")
def task(data: dict[str, pathlib.Path]) -> PushTask:
    return PushTask(data["push"], CONFIG, limit=None, centimetres=(5, 10))


@pytest.fixture(scope="module")
def alone(task: PushTask, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, float]]:
    """Return the learning curve of one device."""
    out = tmp_path_factory.mktemp("alone")
    fit(task, WHOLE, out)
    return files.read_lines(out / "metrics.jsonl")


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_four_devices_learn_what_one_does_and_one_goes_on_from_there(
    processes: int,
    task: PushTask,
    alone: list[dict[str, float]],
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
) -> None:
    _start(data["push"], tmp_path, processes=processes)
    fit(task, WHOLE, tmp_path)
    together = files.read_lines(tmp_path / "metrics.jsonl")
    assert [line["step"] for line in together] == [1, 2, 3, 4] and alone[3]["loss"] != alone[0]["loss"]
    for one, other in zip(alone, together, strict=True):
        assert one.keys() == other.keys()
        np.testing.assert_allclose(list(other.values()), list(one.values()), rtol=1e-4)


def test_a_batch_that_devices_cannot_share_and_unclear_processes_are_one_line() -> None:
    with pytest.raises(UserError, match="--batch 6 --data-parallel: 4 devices share a batch; want a multiple of that"):
        devices.Shared(jax.devices() * 4, batch=6)
    with pytest.raises(UserError, match=r"--processes 2: needs --coordinator HOST:PORT"):
        devices.join(Compute(processes=2))
    with pytest.raises(UserError, match=r"--processes 2 --process 2: want the number of processes"):
        devices.join(Compute(coordinator="localhost:1", processes=2, process=2))


def test_a_process_joins_others_where_a_job_manager_started_several(monkeypatch: pytest.MonkeyPatch) -> None:
    joined: list[int] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_: joined.append(1))
    devices.join(Compute())
    assert not joined
    for name, value, wanted in (
        ("SLURM_STEP_NUM_TASKS", "1", 0),
        ("SLURM_STEP_NUM_TASKS", "8", 1),
        ("OMPI_COMM_WORLD_SIZE", "2", 1),
        ("JOB_COMPLETION_INDEX", "0", 0),  # a Kubernetes job, but no service to ask
    ):
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            joined.clear()
            devices.join(Compute(data_parallel=True))
            assert len(joined) == wanted, name


def test_a_step_is_compiled_and_nothing_written(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["push", "--data", str(data["push"]), "--out", str(tmp_path / "run"), "--batch", "4", "--compile-only"]
    assert console.run("test", cli.COMMANDS, words) == 0
    assert "temporary_mb" in capfd.readouterr().out and not (tmp_path / "run").exists()
