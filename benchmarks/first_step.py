"""How soon a training on many episodes makes its first step, and how much memory it takes until then."""

from __future__ import annotations

import pathlib
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from typing import IO
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
SCRIPT = """
import sys

from dipn_jax.train import cli, devices

own, given = devices.OneDevice.shard_batch, []

def shard_batch(self, examples):
    given.append(1)
    if len(given) == 2:
        print("second batch", file=sys.stderr, flush=True)
    return own(self, examples)

devices.OneDevice.shard_batch = shard_batch
cli.main()
"""
"""`dipn-train`, which says when it has computed a step and hands the next batch over."""


def cost(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure a training: seconds from the start of the command to its first step, and memory of its own until its end.

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
            found = _train(data, pathlib.Path(name) / f"run{end}", memory)
            for what, value in zip(("seconds_to_step", "seconds", "megabytes"), found, strict=True):
                yield f"train.first_step/{what}{end}", value


def _train(data: pathlib.Path, out: pathlib.Path, memory: float) -> tuple[float, float, float]:
    """Run `dipn-train push` for two steps, after which it evaluates and saves.

    Returns:
      Seconds to the first step and to the end of the command, and the most megabytes of memory of its own.
    """
    words = ["push", "--data", str(data), "--out", str(out), "--steps", "2", "--memory", str(memory)]
    begun, most, first = time.perf_counter(), 0.0, list[float]()
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )

    def watch(stream: IO[bytes]) -> None:
        for line in stream:
            if line == b"second batch\n":
                first.append(time.perf_counter())

    assert process.stderr is not None
    watching = threading.Thread(target=watch, args=(process.stderr,))
    watching.start()
    while process.poll() is None:
        status = pathlib.Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
        if found := re.search(r"^RssAnon:\s+(\d+) kB$", status, re.MULTILINE):
            most = max(most, int(found[1]) / 1000)
        time.sleep(LOOKS)
    ended = time.perf_counter()
    watching.join()
    if process.returncode or not first:
        raise RuntimeError(f"dipn-train {' '.join(words)}: ended with {process.returncode}")
    return first[0] - begun, ended - begun, most
