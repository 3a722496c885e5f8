"""The command `dipn-eval report`."""

from __future__ import annotations

import pathlib
from typing import Annotated

import tyro

from dipn_jax.commands import console


def report(
    out: pathlib.Path,
    predictions: Annotated[pathlib.Path | None, tyro.conf.arg(name="prediction")] = None,
    grasps: Annotated[pathlib.Path | None, tyro.conf.arg(name="grasp")] = None,
    clears: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="clear")] = (),
    sweeps: Annotated[pathlib.Path | None, tyro.conf.arg(name="sweep")] = None,
    runs: tuple[pathlib.Path, ...] = (),
    against: str = "",
) -> None:
    """Write one self-contained report.html from the folders of other commands, and their numbers in one metrics.json.

      dipn-eval report --prediction results/prediction --clear results/hard results/30 --runs runs/dipn --out results

    Which of two methods is better, by the difference of objects per action on the same tables:
      dipn-eval report --clear results/dipn+gn results/gn --against gn --out results

    Args:
      out: folder for report.html and metrics.json; of cleared tables table.md and table.csv, too.
      predictions: --out of dipn-eval prediction.
      grasps: --out of dipn-eval grasp.
      clears: --out of any number of dipn-eval clear: methods and tables side by side, beside the paper's numbers.
      sweeps: --out of dipn-eval sweep.
      runs: training runs, for their learning curves.
      against: the row of cleared tables that all others are compared with, by its method, its label, or both as the
        report shows them: gn, bare, or "gn (bare)".
    """
    console.require_out(out)
    from . import page

    sources = page.Sources(prediction=predictions, grasp=grasps, clears=clears, sweep=sweeps, runs=runs)
    values = page.write(out, sources, against=against)
    tables = f"; the tables of results in {out / 'table.md'} and {out / 'table.csv'}" if clears else ""
    console.say(f"{out / 'report.html'}: {len(values)} numbers, also in {out / 'metrics.json'}{tables}")
