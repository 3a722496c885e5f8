"""How soon a training on many episodes makes its first step, and how much memory it takes until then."""

from __future__ import annotations

import pathlib
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from unittest import mock

from dipn_jax.datagen import generate

from benchmarks.encoding import OBJECTS, job, real, synthetic
from benchmarks.harness import Setting, Skipped, quiet

SHARD = 500
"""Episodes in a shard."""
MEMORY = {"": 8.0, "_in_files": 0.1}
"""What is granted by `--memory`, GB, by the end of the figures' names."""
LOOKS = 0.1
"""Seconds between looks at how much memory the training takes."""


def cost(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure a command that makes one step: seconds from its start to its end, and memory of its own.

    The shards hold the same episodes again and again; they are in the system's cache, and so are compiled programs
    from the second training on. Memory of files that are mapped is not counted.
    """
    if not pathlib.Path("/proc/self/status").exists():
        raise Skipped("train.first_step: reads the memory of a process from /proc, which only Linux has")
    episodes = setting.pick(20_000, 1_000_000)
    with tempfile.TemporaryDirectory() as name:
        data = pathlib.Path(name) / "data"
        made = synthetic(real(OBJECTS, 48, setting.seed), SHARD, setting.seed)
        with quiet(), mock.patch.object(generate, "shard", lambda *_: (made, {})):
            generate.generate(job(OBJECTS, SHARD, shards=episodes // SHARD, seed=setting.seed), data)
        _train(data, pathlib.Path(name) / "compiled", MEMORY[""])
        for end, memory in MEMORY.items():
            seconds, megabytes = _train(data, pathlib.Path(name) / f"run{end}", memory)
            yield f"train.first_step/seconds{end}", seconds
            yield f"train.first_step/megabytes{end}", megabytes


def _train(data: pathlib.Path, out: pathlib.Path, memory: float) -> tuple[float, float]:
    """Run `dipn-train push` for one step; return its seconds, and the most megabytes of memory of its own."""
    words = ["push", "--data", str(data), "--out", str(out), "--steps", "1", "--memory", str(memory)]
    begun, most = time.perf_counter(), 0.0
    process = subprocess.Popen(
        [sys.executable, "-m", "dipn_jax.train.cli", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while process.poll() is None:
        status = pathlib.Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
        if found := re.search(r"^RssAnon:\s+(\d+) kB$", status, re.MULTILINE):
            most = max(most, int(found[1]) / 1000)
        time.sleep(LOOKS)
    if process.returncode:
        raise RuntimeError(f"dipn-train {' '.join(words)}: ended with {process.returncode}")
    return time.perf_counter() - begun, most
