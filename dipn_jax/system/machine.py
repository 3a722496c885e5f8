"""Facts about the machine and the sources that made a result."""

from __future__ import annotations

import math
import os
import pathlib
import platform
import subprocess


def processor() -> str:
    """Return the name of the processor, as the operating system gives it."""
    info = pathlib.Path("/proc/cpuinfo")
    rows = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = (row.partition(":")[2].strip() for row in rows if row.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def instructions(*, info: pathlib.Path = pathlib.Path("/proc/cpuinfo")) -> str:
    """Return the instruction set that compilers use here: `x86-64-v4` (AVX-512), `x86-64-v3` (AVX2), or less.

    Args:
      info: what the system says about its processors.
    """
    rows = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    flags = next((set(row.partition(":")[2].split()) for row in rows if row.startswith("flags")), set())
    levels = {"x86-64-v4": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}, "x86-64-v3": {"avx2", "fma"}}
    return next((level for level, needed in levels.items() if needed <= flags), platform.machine().replace("_", "-"))


def boot_id() -> str | None:
    """Return what tells this start of the machine from others; None where the system does not say it."""
    try:
        return pathlib.Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip() or None
    except (OSError, UnicodeDecodeError):
        return None


def cores(
    *, groups: pathlib.Path = pathlib.Path("/sys/fs/cgroup"), own: pathlib.Path = pathlib.Path("/proc/self")
) -> int:
    """Return how many processor cores this process may use: by its affinity, and by the quota of its container.

    Args:
      groups: where control groups are mounted, of version 2 or 1.
      own: folder of this process, whose file `cgroup` names its group.
    """
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = min((_quota(folder) for folder in _groups(groups, own)), default=math.inf)
    return count if quota >= count else max(1, math.floor(quota))


def _groups(groups: pathlib.Path, own: pathlib.Path) -> list[pathlib.Path]:
    """Return the folders of this process' control groups and of those that they are in; each has a quota of its own."""
    try:
        lines = (own / "cgroup").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    found = [groups, groups / "cpu", groups / "cpu,cpuacct"]  # in a container, its own group is mounted there
    for line in lines:
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if not controllers or "cpu" in controllers.split(","):
            place = groups / controllers / path.strip("/")
            found += [place, *(above for above in place.parents if groups in above.parents)]
    return found


def _quota(folder: pathlib.Path) -> float:
    """Return the cores that a control group may use, infinite if there is no quota."""
    try:
        if (folder / "cpu.max").exists():  # version 2: "200000 100000", or "max 100000"
            quota, period = (folder / "cpu.max").read_text(encoding="ascii").split()
        else:
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")  # version 1; -1 is none
            quota, period = ((folder / name).read_text(encoding="ascii") for name in names)
        cores = float(quota) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
    return cores if cores > 0 else math.inf


def commit() -> str:
    """Return the commit of these sources, `-dirty` if a Python file differs from it; `unknown` outside a checkout."""
    git = ["git", "-C", str(pathlib.Path(__file__).parents[2])]
    try:
        head = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, check=True)
        changed = subprocess.run([*git, "status", "--porcelain", "--", "*.py"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head.stdout.decode("ascii").strip() + ("-dirty" if changed.stdout else "")
