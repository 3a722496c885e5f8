"""A framework in a process of its own, so that its peak memory and its threads are its own: both ends of the pipe."""

from __future__ import annotations

import pathlib
import resource
import subprocess
import sys
import time
from collections.abc import Callable

Step = Callable[[], None]


def serve(step: Step, parameters: int) -> None:
    """Answer a line with a number on standard input by the seconds that so many steps took, and the end of input by
    the number of parameters and the highest resident memory in MiB.
    """
    for line in sys.stdin:
        begun = time.perf_counter()
        for _ in range(int(line)):
            step()
        print(time.perf_counter() - begun, flush=True)
    print(parameters, peak_memory(), flush=True)


def peak_memory() -> float:
    """Highest resident memory of this process, MiB; `ru_maxrss` would also count the parent's before the fork."""
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
        """Seconds that so many steps take."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{count}\n")
        self.process.stdin.flush()
        return float(self._line())

    def close(self) -> tuple[int, float]:
        """Number of parameters, and peak memory in MiB."""
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
