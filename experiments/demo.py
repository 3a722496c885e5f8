"""The demo: a small data set of each kind, both networks, their evaluations, and one report.

    python -m experiments.demo          # or make demo, which also sets up .venv

About ten minutes on 2 cores; the report is demo/report.html, its numbers demo/metrics.json. It shows that every part
works, not how good the system can be.
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Sequence

from experiments import command
from experiments.runs import Recipe, Run


def list_runs(root: pathlib.Path) -> list[Run]:
    """Return the demo's commands, which write to `root`."""
    run = Recipe(root)

    # episodes
    pushes = run("data/push", "dipn-datagen push --episodes 1500")
    images = run("data/images", "dipn-datagen images --episodes 100")
    pretrained = run("runs/gn-pretrained", "dipn-train grasp-pretrain --steps 200 --data", images)
    grasps = run(
        "data/grasp",
        "dipn-datagen grasp --objects 1:10 --episodes 1500 --shard-size 500 --grasp-net",
        pretrained,
    )

    # networks
    dipn = run("runs/dipn", "dipn-train push --steps 1000 --data", pushes)
    gn = run("runs/gn", "dipn-train grasp --steps 500 --data", grasps, "--init", pretrained)

    # what they are worth
    prediction = run("eval/prediction", "dipn-eval prediction --scenes 200 --push-net", dipn)
    success = run("eval/grasp", "dipn-eval grasp --scenes 40 --grasp-net", gn)
    networks = ("--push-net", dipn, "--grasp-net", gn)
    hard = run("eval/hard", "dipn-eval clear --cases hard --candidates 16", *networks)
    random = run("eval/random", "dipn-eval clear --cases random --objects 10 --instances 6 --candidates 16", *networks)

    evaluations = ("--prediction", prediction, "--grasp", success, "--clear", [hard, random])
    run("report", "dipn-eval report", *evaluations, "--runs", [dipn, pretrained, gn], out=root)
    return run.runs


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return command.main("demo", str(__doc__), list_runs, folder="demo", arguments=arguments)


if __name__ == "__main__":
    sys.exit(main())
