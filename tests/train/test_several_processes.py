"""Processes of one training find one another, and share the GPUs of their machine."""

import socket
import threading

import jax
import pytest
from dipn_jax.train import devices
from dipn_jax.train.configs import Compute

from dipn_jax.errors import UserError


@pytest.mark.parametrize("odd", ["nohost", "localhost:abc", ":", ":9", "localhost:", "localhost:0", "localhost:99999"])
def test_an_address_that_is_none_is_one_line(odd: str) -> None:
    with pytest.raises(UserError, match=f"^--coordinator {odd}: want HOST:PORT"):
        Compute(data_parallel=True, coordinator=odd, processes=2)
    for good in ("host-0.jobs:65535", "10.0.0.1:9911", "[::1]:9911"):
        Compute(data_parallel=True, coordinator=good, processes=2)


def test_processes_that_do_not_come_or_cannot_join_and_a_port_in_use_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    come = threading.Event()
    monkeypatch.setattr(devices, "WAIT_NOTICE_SECONDS", 0.01)
    monkeypatch.setattr(devices, "WAIT_LIMIT_SECONDS", 0.05)
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_, **__: come.wait())
    second = Compute(data_parallel=True, coordinator="localhost:9", processes=2, process=1)
    with pytest.raises(UserError, match="--coordinator localhost:9: not all processes came within 0 s"):
        devices.join(second)
    come.set()
    assert "--coordinator localhost:9: waiting for the other processes" in capsys.readouterr().err

    def refuse(*_: object, **__: object) -> None:
        raise ValueError("no\nsuch job")

    monkeypatch.setattr(devices, "WAIT_LIMIT_SECONDS", 60)
    monkeypatch.setattr(jax.distributed, "initialize", refuse)
    with pytest.raises(UserError, match=r"--coordinator localhost:9: cannot join \(no\?such job\)"):
        devices.join(second)
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "8")
    with pytest.raises(UserError, match=r"the job manager's processes: cannot join \(no\?such job\)"):
        devices.join(Compute(data_parallel=True))
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        coordinator = f"localhost:{taken.getsockname()[1]}"
        with pytest.raises(UserError, match=f"--coordinator {coordinator}: process 0 cannot listen there"):
            devices.join(Compute(data_parallel=True, coordinator=coordinator, processes=2))


def test_a_process_joins_others_where_a_job_manager_started_several(monkeypatch: pytest.MonkeyPatch) -> None:
    joined: list[int] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **_: joined.append(1))
    devices.join(Compute())
    assert not joined
    for name, value, wanted in (
        ("SLURM_STEP_NUM_TASKS", "1", 0),
        ("SLURM_STEP_NUM_TASKS", "8", 1),
        ("OMPI_COMM_WORLD_SIZE", "2", 1),
        ("JOB_COMPLETION_INDEX", "0", 0),  # a Kubernetes job, but no service to ask
        ("KUBERNETES_SERVICE_HOST", "10.0.0.1", 0),  # a pod of no indexed job
    ):
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            joined.clear()
            devices.join(Compute(data_parallel=True))
            assert len(joined) == wanted, name
    joined.clear()
    monkeypatch.setenv("JOB_COMPLETION_INDEX", "0")
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.0.0.1")
    devices.join(Compute(data_parallel=True))
    assert len(joined) == 1, "an indexed job of Kubernetes"


@pytest.mark.parametrize(
    ("environment", "wanted"),
    [
        ("SLURM_LOCALID=0 SLURM_NODEID=1 SLURM_STEP_TASKS_PER_NODE=1(x2) CUDA_VISIBLE_DEVICES=0,1,2,3", [0, 1, 2, 3]),
        ("SLURM_LOCALID=0 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=1 SLURM_GPUS_ON_NODE=2", [0, 1]),
        ("SLURM_LOCALID=2 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=4 CUDA_VISIBLE_DEVICES=0,1,2,3", [2]),
        ("SLURM_LOCALID=1 SLURM_NODEID=2 SLURM_STEP_TASKS_PER_NODE=4(x2),2 CUDA_VISIBLE_DEVICES=0,1,2,3", [2, 3]),
        ("SLURM_LOCALID=3 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=4 CUDA_VISIBLE_DEVICES=0", [0]),
        (
            "SLURM_LOCALID=1 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=2 CUDA_VISIBLE_DEVICES=0,1 SLURM_GPUS_PER_TASK=2",
            [0, 1],
        ),
        (  # SLURM says so, too, where only cores were asked for
            "SLURM_LOCALID=1 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=2 CUDA_VISIBLE_DEVICES=0,1 "
            "SLURM_TRES_PER_TASK=cpu:4",
            [1],
        ),
        (
            "SLURM_LOCALID=1 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=2 CUDA_VISIBLE_DEVICES=0,1 "
            "SLURM_TRES_PER_TASK=cpu:4,gres/gpu:2",
            [0, 1],
        ),
        (  # mpirun in a job of SLURM, whose variables are then those of mpirun itself
            "SLURM_LOCALID=0 OMPI_COMM_WORLD_LOCAL_RANK=1 OMPI_COMM_WORLD_LOCAL_SIZE=2 CUDA_VISIBLE_DEVICES=0,1",
            [1],
        ),
        ("OMPI_COMM_WORLD_LOCAL_RANK=1 OMPI_COMM_WORLD_LOCAL_SIZE=2 CUDA_VISIBLE_DEVICES=4,5,6,7", [2, 3]),
        ("SLURM_LOCALID=1 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=3 CUDA_VISIBLE_DEVICES=0,1,2,3", None),
        ("SLURM_LOCALID=1 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=odd CUDA_VISIBLE_DEVICES=0,1", None),
        ("SLURM_LOCALID=0 SLURM_NODEID=5 SLURM_STEP_TASKS_PER_NODE=1 CUDA_VISIBLE_DEVICES=0,1", None),
        ("SLURM_LOCALID=0 SLURM_NODEID=0 SLURM_STEP_TASKS_PER_NODE=2", None),
    ],
)
def test_no_gpu_of_a_machine_is_left_idle(environment: str, wanted: list[int] | None) -> None:
    assert devices.local_devices(dict(word.split("=") for word in environment.split())) == wanted
