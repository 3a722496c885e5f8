"""The learning curve of a run: `metrics.jsonl` and TensorBoard events."""

from __future__ import annotations

import json
import os
import pathlib
import time

import jax
import tensorboardX

from dipn_jax.system import files, typed

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


def last(out: pathlib.Path) -> dict[str, float]:
    """Return the last line of a run's `metrics.jsonl`; empty where there is none."""
    lines = files.read_lines(out / "metrics.jsonl")
    return lines[-1] if lines else {}


def _step_of(line: str) -> float:
    """Return the step of a line of `metrics.jsonl`; infinite if a hard stop cut the line."""
    try:
        return float(typed.check(typed.parse(line), {"step": float})["step"])
    except typed.Misfit:
        return float("inf")


class Log:
    """Writer of a run's learning curve; lines past the restored step are dropped.

    TensorBoard and the progress line also get examples a second since the point before, without the time of compiling,
    evaluating and saving, and the most memory in MB that was needed so far: of the device, or of the process where the
    device is a CPU.
    """

    def __init__(self, out: pathlib.Path, begin: int, *, batch: int, writes: bool = True) -> None:
        """Open the files of a run that continues after step `begin`, if this process `writes` them."""
        self.path, self._batch = out / "metrics.jsonl", batch
        self._since: tuple[int, float] | None = None  # step and time since which steps are timed; None: a pause
        self._timed = (0, 0.0)  # steps, and their seconds, since the point before
        self._events: tensorboardX.SummaryWriter | None = None
        if writes:
            old = files.read_text(self.path).splitlines() if self.path.exists() else []
            kept = [line for line in old if _step_of(line) <= begin]
            files.write_text(self.path, "".join(line + "\n" for line in kept))
            self._events = tensorboardX.SummaryWriter(str(out / "events"), purge_step=begin)

    def resume(self, step: int) -> None:
        """Time steps from now on; `step` of them are done."""
        self._since = step, time.monotonic()

    def pause(self, step: int) -> None:
        """Time no steps from now on; `step` of them are done, and computed."""
        if self._since is not None:
            (count, seconds), (before, then) = self._timed, self._since
            self._timed = count + step - before, seconds + time.monotonic() - then
            self._since = None

    def write(self, step: int, values: dict[str, float]) -> str:
        """Write a point of the curve, wait until it is on the disk, and return speed and memory in words."""
        if self._events is None:
            return ""
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"step": step, **values}, allow_nan=False) + "\n")
            stream.flush()
            os.fsync(stream.fileno())  # before the step that it belongs to is saved
        (count, seconds), self._timed = self._timed, (0, 0.0)
        speed = ({"examples_per_s": count * self._batch / seconds} if seconds else {}) | _peak()
        for name, value in (values | speed).items():
            self._events.add_scalar(name, value, step)
        return " ".join(f"{name} {value:.0f}" for name, value in speed.items())

    def close(self) -> None:
        """Write what is left and close the files."""
        if self._events:
            self._events.close()


def _peak() -> dict[str, float]:
    """Return the most memory that was needed so far in MB, by its name; nothing where the system does not say it."""
    found = jax.local_devices()[0].memory_stats()
    if found and "peak_bytes_in_use" in found:
        return {"peak_memory_mb": float(found["peak_bytes_in_use"]) / 1e6}
    if resource is None:
        return {}
    return {"peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}
