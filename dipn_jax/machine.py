"""The machine and the sources that results were made with."""

from __future__ import annotations

import os
import pathlib
import platform
import subprocess


def processor() -> str:
    """Name of the processor, as the operating system gives it."""
    info = pathlib.Path("/proc/cpuinfo")
    rows = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = (row.partition(":")[2].strip() for row in rows if row.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def commit() -> str:
    """Commit of these sources, with `-dirty` where a Python file differs from it; `unknown` outside of a checkout."""
    git = ["git", "-C", str(pathlib.Path(__file__).parent.parent)]
    try:
        head = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, check=True)
        changed = subprocess.run([*git, "status", "--porcelain", "--", "*.py"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head.stdout.decode("ascii").strip() + ("-dirty" if changed.stdout else "")
