"""Feed mutated files to every parser that reads a user's files, and count the outcomes.

    python -m experiments.fuzz                        # 10,000 inputs to each parser
    python -m experiments.fuzz --only shard --inputs 500
    python -m experiments.fuzz --list

An input is accepted, or refused with one line (`UserError`); anything else is a traceback, which the command shows.
`docs/reliability.json` has the counts under `fuzz`.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import dataclasses
import io
import pathlib
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import console, markdown
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine
from experiments import fuzz_parsers, pages
from experiments.fuzz_parsers import Parser

RESULTS = "reliability"
"""Name of the file in docs."""
OUTCOMES = ("accepted", "refused", "tracebacks")
"""The outcomes that an input can have."""
SHOWN = 5
"""Tracebacks that are shown of each parser."""


@dataclasses.dataclass
class Count:
    """How many inputs of a parser had each outcome."""

    outcomes: collections.Counter[str]
    failures: list[str]  # tracebacks, the first ones, each kind once
    seconds: float


def outcome(parser: Parser, folder: pathlib.Path) -> tuple[str, str]:
    """Return the outcome of parsing the folder's file (one of OUTCOMES), and the message."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # a number that overflows is no number
            parser.read(folder)
    except UserError as error:
        text = str(error)
        return ("refused", text) if text and "\n" not in text else ("tracebacks", f"not one line: {text!r}")
    except Exception:
        return "tracebacks", traceback.format_exc()
    return "accepted", said.getvalue()


def fuzz(parser: Parser, inputs: int, folder: pathlib.Path, *, seed: int = 0) -> Count:
    """Give a parser `inputs` mutations of its valid file.

    Raises:
      RuntimeError: the valid file is not accepted.
    """
    begun = time.perf_counter()
    parser.prepare(folder)
    path = folder / parser.file
    valid = path.read_bytes()
    kind, said = outcome(parser, folder)
    if kind != "accepted":
        raise RuntimeError(f"{parser.name}: its valid file is not accepted: {said}")
    counts, failures = collections.Counter(dict.fromkeys(OUTCOMES, 0)), dict[str, str]()
    with console.Progress(parser.name, inputs, unit="inputs") as progress:
        for number in range(inputs):
            path.write_bytes(parser.mutate(random.Random(f"{seed} {parser.name} {number}"), valid))
            kind, said = outcome(parser, folder)
            counts[kind] += 1
            if kind == "tracebacks":
                failures.setdefault("\n".join(said.splitlines()[-3:]), f"input {number}: {said}")
            progress.advance(1, f"{counts['tracebacks']} tracebacks")
    return Count(counts, list(failures.values())[:SHOWN], time.perf_counter() - begun)


def table(values: dict[str, Any]) -> str:
    """Return the table of the page as Markdown.

    Args:
      values: parser -> its counts, as the file of results has them.
    """
    rows = [[name, *(f"{found[key]:,}" for key in ("inputs", *OUTCOMES))] for name, found in values.items()]
    return markdown.table(["parser", "inputs", "accepted", "refused in one line", "tracebacks"], rows)


def write(path: pathlib.Path, found: dict[str, Any]) -> dict[str, Any]:
    """Write the counts of some parsers to the file of results, beside what stands there; return those of all."""
    values = files.read_json(path) if path.exists() else {}
    kept = {**values.get("fuzz", {}), **found}
    files.write_json(path, {**values, "fuzz": {name: kept[name] for name in fuzz_parsers.PARSERS if name in kept}})
    return kept


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="show the parsers")
    parser.add_argument("--dry-run", action="store_true", help="show what would be done")
    parser.add_argument("--only", nargs="+", default=[], metavar="PARSER", help="these parsers")
    parser.add_argument("--inputs", type=int, default=10_000, help="given to each parser")
    parser.add_argument("--seed", type=int, default=0, help="of the inputs")
    parser.add_argument(
        "--results", type=pathlib.Path, default=pages.DOCS / f"{RESULTS}.json", metavar="FILE", help="of the counts"
    )
    options = parser.parse_args(arguments)
    return console.exit_code(lambda: _work(options))


def _work(options: argparse.Namespace) -> int:
    if unknown := sorted(set(options.only) - set(fuzz_parsers.PARSERS)):
        raise UserError(f"--only {unknown[0]}: no such parser; want one of {', '.join(fuzz_parsers.PARSERS)}")
    console.require_positive(inputs=options.inputs)
    chosen = [one for name, one in fuzz_parsers.PARSERS.items() if not options.only or name in options.only]
    if options.list:
        console.say("\n".join(f"{one.name}: {one.file}" for one in chosen))
        return 0
    if options.dry_run:
        console.say("\n".join(f"{one.name}: {options.inputs} mutations of {one.file}" for one in chosen))
        return 0
    kept: dict[str, Any] = {}
    failed = 0
    for one in chosen:
        with tempfile.TemporaryDirectory() as folder:
            found = fuzz(one, options.inputs, pathlib.Path(folder), seed=options.seed)
        failed += found.outcomes["tracebacks"]
        console.say("\n".join([f"{one.name}: {dict(found.outcomes)}, {found.seconds:.0f} s", *found.failures]))
        counts = {"inputs": options.inputs, **found.outcomes, "seed": options.seed, "commit": machine.commit()}
        kept = write(options.results, {one.name: counts})
    console.say(table({one.name: kept[one.name] for one in chosen}))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
