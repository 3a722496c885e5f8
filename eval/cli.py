"""The program `dipn-eval`: prediction, grasp, clear, sweep, merge, report."""

from __future__ import annotations

import sys

from dipn_jax.commands import console

from .clearing import command as clearing
from .clearing import sweep_command as sweeping
from .grasping import command as grasping
from .prediction import command as prediction
from .report import command as report
from .workers import merging

COMMANDS = {
    "prediction": prediction.predict,
    "grasp": grasping.grasp,
    "clear": clearing.clear,
    "sweep": sweeping.sweep,
    "merge": merging.merge,
    "report": report.report,
}
"""The commands of `dipn-eval`, by name."""


def main() -> None:
    """Run `dipn-eval` and exit with its exit code."""
    sys.exit(console.run("Measure predictors, grasps and whole policies; write the report.", COMMANDS))


if __name__ == "__main__":
    main()
