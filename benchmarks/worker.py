"""Run a framework in a process of its own, to measure its memory and threads alone: both ends of the pipe."""

from __future__ import annotations

import functools
import pathlib
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.harness import alternate

RATE = 1e-3
"""Learning rate of SGD."""
MOMENTUM = 0.9
"""Momentum of SGD."""
Step = Callable[[], None]
"""Takes one step, and returns when it is done."""
FLOAT32 = "float32"
"""The precision of `train.precision` that networks compute in unless another is given."""


def serve(step: Step, parameters: int) -> None:
    """Read numbers of steps from standard input and print the seconds each takes; at the end parameters and memory."""
    for line in sys.stdin:
        begun = time.perf_counter()
        for _ in range(int(line)):
            step()
        print(time.perf_counter() - begun, flush=True)
    print(parameters, peak_memory(), flush=True)


def sgd(model: Any, loss: Callable[[Any], Any]) -> tuple[Step, int]:
    """Return a jitted step of SGD with momentum on `loss` (of a network in flax.nnx), and the number of parameters."""
    import jax
    import optax
    from flax import nnx

    model.train()
    graph, params, rest = nnx.split(model, nnx.Param, ...)  # type: ignore[misc]
    optimizer = optax.sgd(RATE, momentum=MOMENTUM)
    state = [params, rest, optimizer.init(params)]

    @jax.jit
    def step(params: Any, rest: Any, moments: Any) -> Any:
        def value_of(p: Any) -> Any:
            network = nnx.merge(graph, p, rest, copy=True)
            return loss(network), nnx.split(network, nnx.Param, ...)[2]  # type: ignore[misc]

        (value, rest), gradient = jax.value_and_grad(value_of, has_aux=True)(params)
        updates, moments = optimizer.update(gradient, moments, params)
        return optax.apply_updates(params, updates), rest, moments, value

    def run() -> None:
        *state[:], value = step(*state)
        value.block_until_ready()

    return run, sum(leaf.size for leaf in jax.tree.leaves(params))


def torch_device() -> Any:
    """Return the device that PyTorch computes on, a GPU where it has one, and make new tensors there.

    Products of matrices are then as precise as JAX's are there: TF32, as those of convolutions in both.
    """
    import torch

    from dipn_jax.system.machine import cores

    torch.set_num_threads(cores())
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device.type == "cuda":
        torch.set_default_device(device)
        torch.set_float32_matmul_precision("high")
    return device


def torch_sgd(model: Any, loss: Callable[[], Any], *, device: Any, precision: str) -> Step:
    """Return a step of SGD with momentum on `loss` of a network in PyTorch."""
    import torch

    optimizer = torch.optim.SGD(model.parameters(), RATE, MOMENTUM)
    lower = precision != FLOAT32

    def run() -> None:
        optimizer.zero_grad()
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=lower):
            value = loss()
        value.backward()
        optimizer.step()
        wait_for(device)

    return run


def wait_for(device: Any) -> None:
    """Wait until PyTorch has done all work on a device."""
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize()


def peak_memory() -> float:
    """Return the highest resident memory of this process in MiB; `ru_maxrss` would include the parent's."""
    status = pathlib.Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


class Worker:
    """A process that runs `serve`."""

    def __init__(self, module: str, *arguments: object) -> None:
        """Start `python -m benchmarks.MODULE ARGUMENTS`; the first step, which compiles, is not counted."""
        command = [sys.executable, "-m", f"benchmarks.{module}", *map(str, arguments)]
        root = pathlib.Path(__file__).parent.parent
        self.process = subprocess.Popen(command, cwd=root, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.steps(1)

    def steps(self, count: int) -> float:
        """Return the seconds that `count` steps take."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{count}\n")
        self.process.stdin.flush()
        return float(self._line())

    def close(self) -> tuple[int, float]:
        """End the process and return its number of parameters and its peak memory in MiB."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        parameters, memory = self._line().split()
        self.process.wait()
        return int(parameters), float(memory)

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{' '.join(map(str, self.process.args))}: ended early")  # type: ignore[arg-type]
        return line


def versus(
    figure: str, module: str, arguments: tuple[object, ...], *, batch: int, count: int, repeats: int
) -> Iterator[tuple[str, float]]:
    """Measure seconds of a training step in PyTorch over ours, as `FIGURE`; also samples per second and memory.

    Raises:
      RuntimeError: the two networks have different numbers of parameters.
    """
    workers = [Worker(module, framework, *arguments) for framework in ("jax", "torch")]
    ours, theirs = alternate(*[functools.partial(each.steps, count) for each in workers], repeats=repeats)
    (mine, memory), (others, their_memory) = [each.close() for each in workers]
    if mine != others:
        raise RuntimeError(f"{figure}: {mine} parameters against {others} in PyTorch: not the same network")
    yield figure, theirs / ours
    yield f"{figure}_samples_per_second", batch * count / ours
    yield f"{figure}_memory", memory / their_memory
