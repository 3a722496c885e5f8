"""Mutation testing: change the code that computes numbers, one operator at a time, and see whether a test fails.

    python -m experiments.mutants                                # all modules: hours on 2 cores
    python -m experiments.mutants --only eval/metrics.py         # one: minutes
    python -m experiments.mutants --list                         # modules, and the tests of each

Cosmic Ray (the extra `mutants`) makes the mutants, in a scratch copy of this checkout. Interrupted, the same command
continues. `docs/testing.json` and the table of `docs/testing.md` have the result of every module that was measured.
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import console, markdown
from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments import mutants_session, pages

TESTS: dict[str, tuple[str, ...]] = {
    "eval/metrics.py": ("tests/eval/test_metrics.py", "tests/eval/test_known_numbers.py"),
    "eval/clearing/lockstep.py": ("tests/eval/clearing/test_end_rules.py", "tests/eval/clearing/test_counts.py"),
    "dipn_jax/networks/losses.py": ("tests/dipn_jax/networks/test_losses.py",),
    "train/split.py": (
        "tests/train/test_split.py",
        "tests/train/test_example_order.py",
        "tests/train/test_several_data_sets.py",
    ),
    "dipn_jax/sight/masks.py": ("tests/dipn_jax/sight/test_masks.py",),
    "dipn_jax/sight/imagine.py": ("tests/dipn_jax/sight/test_imagine.py",),
    "dipn_jax/planning/planner.py": ("tests/dipn_jax/planning/test_planner.py",),
    "dipn_jax/planning/candidates.py": ("tests/dipn_jax/planning/test_candidates.py",),
    "dipn_jax/planning/memory.py": ("tests/dipn_jax/planning/test_memory.py",),
    "dipn_jax/planning/expected_misses.py": ("tests/dipn_jax/planning/test_expected_misses.py",),
    "dipn_jax/storage/records.py": ("tests/dipn_jax/storage/test_records.py",),
    "dipn_jax/world/scenes.py": ("tests/dipn_jax/world/test_scenes.py",),
    "eval/curves.py": ("tests/eval/test_known_numbers.py", "tests/eval/test_curves.py"),
    "eval/prediction/push_errors.py": (
        "tests/eval/test_known_numbers.py",
        "tests/eval/prediction/test_push_errors.py",
    ),
    "eval/prediction/pushes.py": ("tests/eval/prediction/test_pushes.py",),
    "eval/grasping/success.py": ("tests/eval/grasping/test_success.py",),
    "eval/clearing/instances.py": ("tests/eval/clearing/test_instances.py", "tests/eval/clearing/test_lockstep.py"),
    "eval/clearing/camera.py": ("tests/eval/clearing/test_camera.py",),
    "eval/clearing/rollouts.py": ("tests/eval/clearing/test_rollouts.py",),
    "eval/clearing/sweeping.py": ("tests/eval/clearing/test_sweeping.py",),
    "eval/clearing/evaluation.py": ("tests/eval/clearing/test_command.py",),
    "eval/clearing/tables.py": ("tests/eval/clearing/test_command.py",),
    "eval/clearing/on_tables.py": ("tests/eval/clearing/test_command.py",),
    "eval/report/comparison.py": ("tests/eval/report/test_comparison.py", "tests/eval/report/test_causes.py"),
    "eval/report/results.py": ("tests/eval/report/test_results.py",),
    "experiments/clearing_numbers.py": ("tests/experiments/test_kept_results.py",),
}
"""Module that computes a number in a table -> the tests that its mutants are held against, the fastest first."""

PAGE = "testing"
"""Name of the page in docs and of its JSON."""


def section(values: dict[str, Any]) -> str:
    """Return as Markdown the totals, the table of the measured modules, and a sentence that names the others.

    Args:
      values: module -> its `mutants_session.result`; a module that is missing was not measured.
    """
    rows = []
    for module in TESTS:
        if found := values.get(module):
            share = 100 * found["killed"] / max(found["mutants"], 1)
            killed = f"{found['killed']} ({share:.1f} %)"
            rows.append([f"`{module}`", str(found["mutants"]), killed, str(len(found["survivors"]))])
    total, killed = (sum(found[key] for found in values.values()) for key in ("mutants", "killed"))
    share = 100 * killed / max(total, 1)
    measured = (
        f"{len(values)} of {len(TESTS)} modules are measured: {killed} of {total} mutants killed ({share:.1f} %)."
    )
    text = f"{measured}\n\n{markdown.table(['module', 'mutants', 'killed', 'survivors'], rows)}"
    if missing := [f"`{module}`" for module in TESTS if module not in values]:
        text += "\n" + textwrap.fill(f"Not measured yet: {', '.join(missing)}.", 120, break_on_hyphens=False) + "\n"
    return text


def box(values: dict[str, Any]) -> str:
    """Return the page's box as Markdown: the commits at which modules were measured; arguments as of `section`."""
    modules: dict[str, list[str]] = {}
    for module, found in values.items():
        modules.setdefault(found["commit"], []).append(module)
    lines = [f"commit {commit}: {', '.join(named)}" for commit, named in modules.items()]
    wrapped = [textwrap.fill(line, pages.BOX_WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in lines]
    return "\n".join(["```", *wrapped, "```"]) + "\n"


def write_page(values: dict[str, Any], *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write `testing.json`, and its section and box into `testing.md`."""
    page = docs / f"{PAGE}.md"
    files.write_json(docs / f"{PAGE}.json", values)
    files.write_text(page, pages.with_box(pages.with_tables(files.read_text(page), section(values)), box(values)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.mutants",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--list", action="store_true", help="show the modules and the tests of each")
    parser.add_argument("--dry-run", action="store_true", help="show the command that would be run on each mutant")
    parser.add_argument("--only", nargs="+", default=[], metavar="MODULE", help="these modules")
    parser.add_argument(
        "--out", type=pathlib.Path, default=pathlib.Path("results/mutants"), metavar="FOLDER", help="of the sessions"
    )
    options = parser.parse_args(arguments)
    return console.exit_code(lambda: _work(options))


def _work(options: argparse.Namespace) -> int:
    if unknown := sorted(set(options.only) - set(TESTS)):
        raise UserError(f"no module {unknown[0]!r} in the list; want one of those that --list shows")
    chosen = [module for module in TESTS if not options.only or module in options.only]
    for module in chosen:
        if options.list:
            console.say(f"{module}\n  {' '.join(TESTS[module])}")
        elif options.dry_run:
            console.say(f"{module}: {mutants_session.test_command(TESTS[module])}")
        else:
            console.require_out(options.out)
            found = mutants_session.run(module, TESTS[module], options.out.resolve())
            kept = pages.DOCS / f"{PAGE}.json"
            write_page({**(files.read_json(kept) if kept.exists() else {}), module: found})
            console.say(f"{module}: {found['killed']} of {found['mutants']} killed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
