"""Batches shared by devices and processes: what is learnt is what one device learns, but for rounding."""

import dataclasses
import os
import pathlib
import signal
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from dipn_jax.train import devices, profiling
from dipn_jax.train.configs import Compute, TrainConfig
from dipn_jax.train.loop import fit, make_step
from dipn_jax.train.push import PushTask
from flax import nnx

from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.storage import checkpoint
from dipn_jax.system import files

CONFIG = DipnConfig(width=8)
WHOLE = TrainConfig(steps=12, batch=4, learning_rate=1e-4, optimizer="sgd", eval_every=4, save_every=4)
RTOL = 1e-4
"""By what the numbers of a curve may differ."""
SCRIPT = """
import pathlib, sys
from dipn_jax.commands import console
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.train import devices
from dipn_jax.train.configs import Compute, TrainConfig

data, out, sent = sys.argv[1:]
limit = None
console.enable_compilation_cache()
compute = Compute(data_parallel=True)
import functools, jax, os, signal
jax.distributed.initialize = functools.partial(jax.distributed.initialize, heartbeat_timeout_seconds=10)
devices.join(compute)
from dipn_jax.errors import UserError
from dipn_jax.train.loop import fit
from dipn_jax.train.push import PushTask

assert jax.device_count() == 4 and jax.local_device_count() == 2
if sent == "other data" and jax.process_index():
    limit = 8
task = PushTask(pathlib.Path(data), DipnConfig(width=8), limit=limit, centimetres=(5, 10))
own, shared = devices.Shared.shard_batch, []

def shard_batch(self, examples):
    shared.append(len(examples.taught))
    if jax.process_index() == 1 and len(shared) == 5:
        os.kill(os.getpid(), signal.Signals[sent])
    return own(self, examples)

devices.Shared.shard_batch = shard_batch
plan = TrainConfig(steps=12, batch=4, learning_rate=1e-4, optimizer="sgd", eval_every=4, save_every=4)
try:
    fit(task, plan, pathlib.Path(out), compute=compute)
except KeyboardInterrupt:
    sys.exit(0 if shared == [2] * devices.SYNC_EVERY else 1)
except UserError as error:
    sys.exit(2 if "data of processes 0 and 1 of this job differ" in str(error) else 1)
sys.exit("was not interrupted")
"""
"""DIPN learns on four devices of two processes; the second one gets a signal at its fifth step, which ends both.

Where `sent` is "other data" and no signal, the second process learns from fewer episodes.
"""


ONE_PROCESS = """
import pathlib, sys
from dipn_jax.commands import console
console.enable_compilation_cache()

import jax
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.train.configs import Compute, TrainConfig
from dipn_jax.train.loop import fit
from dipn_jax.train.push import PushTask

assert jax.device_count() == jax.local_device_count() == 4
task = PushTask(pathlib.Path(sys.argv[1]), DipnConfig(width=8), limit=None, centimetres=(5, 10))
plan = TrainConfig(steps=12, batch=4, learning_rate=1e-4, optimizer="sgd", eval_every=4, save_every=4)
fit(task, plan, pathlib.Path(sys.argv[2]), compute=Compute(data_parallel=True))
"""
"""DIPN learns on four devices of one process."""


def _start(data: pathlib.Path, out: pathlib.Path, sent: str) -> tuple[int, int]:
    """Run the script in two processes of two devices each, which find one another by the variables that SLURM sets.

    Returns:
      Their exit codes.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    job = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "2", "SLURM_STEP_NUM_TASKS": "2", "SLURM_STEP_NODELIST": "localhost"}
    flags |= job | {"JAX_COORDINATOR_PORT": str(port)}
    words = [sys.executable, "-c", SCRIPT, str(data), str(out), sent]
    going = []
    for each in range(2):
        own = {"SLURM_PROCID": str(each), "SLURM_LOCALID": str(each)}
        started = subprocess.Popen(words, env=os.environ | flags | own, stderr=subprocess.PIPE, text=True)
        going.append(started)
    said = [process.communicate(timeout=300)[1] for process in going]
    print(said[0][-3000:])  # pytest shows it if a test fails
    assert "train dipn" not in said[1], "one of them says how far the run is"
    return going[0].returncode, going[1].returncode


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
def test_four_devices_learn_what_one_does_and_one_goes_on_from_there(
    task: PushTask,
    alone: list[dict[str, float]],
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
) -> None:
    assert _start(data["push"], tmp_path, "SIGTERM") == (0, 0)
    assert max(path.name for path in (tmp_path / "checkpoints").iterdir()) == f"{devices.SYNC_EVERY:08d}"
    fit(task, WHOLE, tmp_path)
    together = files.read_lines(tmp_path / "metrics.jsonl")
    _check(together, alone)


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_others_and_nothing_saved_is_lost(
    task: PushTask, alone: list[dict[str, float]], data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    assert _start(data["push"], tmp_path, "SIGKILL") == (-signal.SIGABRT, -signal.SIGKILL)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["00000004"]
    fit(task, WHOLE, tmp_path)
    _check(files.read_lines(tmp_path / "metrics.jsonl"), alone)


@pytest.mark.slow
def test_processes_with_other_data_are_told_so_before_anything_is_written(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    assert _start(data["push"], tmp_path / "run", "other data") == (2, 2)
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.slow
def test_four_devices_of_one_process_go_on_where_one_device_stopped(
    task: PushTask, alone: list[dict[str, float]], data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    fit(task, dataclasses.replace(WHOLE, steps=4), tmp_path)
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "JAX_PLATFORMS": "cpu"}
    words = [sys.executable, "-c", ONE_PROCESS, str(data["push"]), str(tmp_path)]
    subprocess.run(words, env=os.environ | flags, check=True, timeout=300)
    _check(files.read_lines(tmp_path / "metrics.jsonl"), alone)


def _check(curve: list[dict[str, float]], alone: list[dict[str, float]]) -> None:
    """Compare a curve with that of one device, which has to learn far more than the two may differ by."""
    assert [line["step"] for line in curve] == [4, 8, 12]
    first, last = alone[0]["held_out_loss"], alone[2]["held_out_loss"]
    assert last < (1 - 100 * RTOL) * first
    for one, other in zip(alone, curve, strict=True):
        assert one.keys() == other.keys()
        np.testing.assert_allclose(list(other.values()), list(one.values()), rtol=RTOL)


def test_a_batch_that_devices_cannot_share_and_unclear_processes_are_one_line() -> None:
    with pytest.raises(UserError, match="--batch 6 --data-parallel: 4 devices share a batch; want a multiple of that"):
        devices.Shared(jax.devices() * 4, batch=6)
    for given in ({"processes": 2}, {"process": 3}):
        with pytest.raises(UserError, match=r"--processes \d --process \d: needs --coordinator HOST:PORT"):
            Compute(**given)
    with pytest.raises(UserError, match=r"--processes 2 --process 2: want the number of processes"):
        Compute(coordinator="localhost:1", processes=2, process=2)
    with pytest.raises(UserError, match="--coordinator localhost:1: needs --data-parallel"):
        Compute(coordinator="localhost:1", processes=2)


@pytest.mark.slow
def test_a_step_is_compiled_and_nothing_written(task: PushTask, tmp_path: pathlib.Path) -> None:
    planned = fit(task, WHOLE, tmp_path / "run", compute=Compute(compile_only=True))
    weights = sum(leaf.nbytes for leaf in jax.tree.leaves(nnx.state(checkpoint.build("dipn", CONFIG))))
    assert weights / 1e6 < planned["arguments_mb"] < 50 and planned["temporary_mb"] > 0.1
    assert not (tmp_path / "run").exists()


class Line:
    """A toy to learn: y = 2 x."""

    def __init__(self) -> None:
        self.seen: list[jnp.dtype] = []

    def loss(self, model: nnx.Module, batch: tuple[jax.Array, jax.Array], key: jax.Array) -> jax.Array:
        x, y = batch
        found = model(x)  # type: ignore[operator]
        self.seen.append(found.dtype)
        return jnp.mean((found - y) ** 2)


def _stepped(compute: Compute) -> tuple[Line, dict[str, np.ndarray], float]:
    """Return the toy, its weights and its loss after one step on eight examples."""
    task, model = Line(), nnx.Linear(3, 1, rngs=nnx.Rngs(0))
    graph, params, rest = nnx.split(model, nnx.Param, ...)
    optimizer = optax.sgd(0.1)
    x = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    step = make_step(task, graph, optimizer, compute=compute)
    params, _, _, loss = step(params, rest, optimizer.init(params), (x, 2 * x[:, :1]), jax.random.key(0))
    return task, {name: np.asarray(leaf) for name, leaf in nnx.to_pure_dict(params).items()}, float(loss)


def test_parts_of_a_batch_give_the_gradient_of_all_of_it() -> None:
    _, whole, loss = _stepped(Compute())
    _, parts, other = _stepped(Compute(accumulate=4))
    np.testing.assert_allclose(other, loss, rtol=1e-6)
    for name, leaf in whole.items():
        np.testing.assert_allclose(parts[name], leaf, rtol=1e-5)


def test_layers_compute_in_half_precision_and_weights_stay() -> None:
    exact, single, loss = _stepped(Compute())
    task, half, other = _stepped(Compute(precision="bfloat16"))
    assert exact.seen[0] == jnp.float32 and task.seen[0] == jnp.bfloat16
    assert other != loss and abs(other / loss - 1) < 0.02
    for name, leaf in half.items():
        assert leaf.dtype == np.float32
        np.testing.assert_allclose(leaf, single[name], atol=0.01)


@pytest.mark.slow
def test_half_precision_learns_what_single_precision_does(
    task: PushTask, alone: list[dict[str, float]], tmp_path: pathlib.Path
) -> None:
    fit(task, WHOLE, tmp_path, compute=Compute(precision="bfloat16"))
    for one, other in zip(alone, files.read_lines(tmp_path / "metrics.jsonl"), strict=True):
        assert one["held_out_loss"] != other["held_out_loss"]
        for name in ("loss", "held_out_loss"):
            assert abs(other[name] / one[name] - 1) < 0.1


def test_some_steps_are_profiled(tmp_path: pathlib.Path) -> None:
    with profiling.Profiler(tmp_path, 7) as profiler:
        for step in range(7, 7 + profiling.LAST_STEP):
            profiler.see(step)
            assert not list(tmp_path.rglob("*.xplane.pb"))
        profiler.see(7 + profiling.LAST_STEP)
        assert list(tmp_path.rglob("*.xplane.pb"))
    with profiling.Profiler(tmp_path / "cut", 0) as profiler:
        profiler.see(profiling.FIRST_STEP)
    assert list((tmp_path / "cut").rglob("*.xplane.pb")), "a run that ends early"
