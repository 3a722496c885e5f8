"""How long a command takes to answer `--help`."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Iterator

from benchmarks.harness import Setting, alternate

HELPS = (("eval",), ("train",), ("datagen",), ("eval", "clear"), ("train", "push"))
"""Command lines that are measured, without `--help`: the module of the command, and one of its own commands."""


def _python(*arguments: str) -> None:
    """Run a Python process to its end."""
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def help_vs_jax(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of a command's `--help` over seconds of `import jax`: of the slowest command, and of each."""
    repeats = setting.pick(5, 15)
    ratios: dict[str, float] = {}
    slowest = 0.0
    for stage, *command in HELPS:
        answer = functools.partial(_python, "-m", f"dipn_jax.{stage}.cli", *command, "--help")
        import_jax = functools.partial(_python, "-c", "import jax")
        helped, imported = alternate(answer, import_jax, repeats=repeats)
        ratios["-".join((stage, *command))] = helped / imported
        slowest = max(slowest, helped)
    yield "cli.help_vs_jax", max(ratios.values())
    yield "cli.help_vs_jax/seconds", slowest
    for name, ratio in ratios.items():
        yield f"cli.help_vs_jax/{name}", ratio
