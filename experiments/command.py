"""The command line of every experiment."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable, Sequence

from dipn_jax.commands import console
from experiments import kept_results, runs
from experiments.runs import Run

ListRuns = Callable[[pathlib.Path], list[Run]]
"""Returns the runs of an experiment, in order, for the folder of all results."""

WritePage = Callable[[pathlib.Path], None]
"""Writes an experiment's page from the results of its runs in that folder."""


def main(
    module: str,
    description: str,
    list_runs: ListRuns,
    *,
    folder: str = "results",
    page: WritePage | None = None,
    page_on_request: bool = False,
    keep_in: pathlib.Path | None = None,
    arguments: Sequence[str] | None = None,
) -> int:
    """Run the command line of an experiment and return the exit code.

    Args:
      module: its name, for the help.
      description: its docstring.
      list_runs: its runs.
      folder: where results go unless `--out` says otherwise.
      page: what to write when all runs are complete.
      page_on_request: whether it is written only where `--page` asks for it, which carries out no run.
      keep_in: file that keeps the results of evaluations; what is kept there is not carried out again.
      arguments: of the command line; those of the process if not given.
    """
    options = _parser(module, description, folder, page_on_request).parse_args(arguments)

    def work() -> int:
        listed = list_runs(options.out)
        chosen = runs.select(listed, options.only)
        if options.list:
            return _show(chosen)
        if page and page_on_request and options.page:
            page(options.out)
            return 0
        found, after = runs.keys(listed), _forget
        if keep_in:
            results = kept_results.Kept(keep_in)
            chosen, after = kept_results.missing(listed, options.only, found, results), results.keep
        if options.dry_run:
            return _rehearse(chosen, found)
        console.require_out(options.out)
        code = runs.carry_out(chosen, found, after=after)
        if not code and page and not page_on_request and len(chosen) == len(listed):
            page(options.out)
        return code

    return console.exit_code(work)


def _parser(module: str, description: str, folder: str, page_on_request: bool) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{module}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--list", action="store_true", help="show the names of the runs and their commands")
    parser.add_argument("--dry-run", action="store_true", help="check every command and say what is left to do")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="NAME",
        help="these runs (`a` stands for all called a/...) and those that they need; no page is written",
    )
    parser.add_argument(
        "--out", type=pathlib.Path, default=pathlib.Path(folder), metavar="FOLDER", help=f"of results ({folder})"
    )
    if page_on_request:
        parser.add_argument(
            "--page", action="store_true", help="write the page in docs from complete runs; run nothing"
        )
    return parser


def _forget(run: Run, key: str) -> None:
    """Keep nothing of a run that is complete but its folder."""


def _show(chosen: Sequence[Run]) -> int:
    for run in chosen:
        console.say(f"{run.name}\n  {run.line}")
    return 0


def _rehearse(chosen: Sequence[Run], found: dict[str, str]) -> int:
    """Parse every command with its own parser, without running it, and say which runs are complete."""
    for number, run in enumerate(chosen, 1):
        runs.parse(run)
        state = "complete" if runs.is_complete(run, found[run.name]) else run.line
        console.say(f"[{number}/{len(chosen)}] {run.name}: {state}")
    return 0
