"""The page of what runs survive: promises, the tests that hold them, and counts of what was tried.

    python -m experiments.reliability             # damages a checkpoint in every way and writes the page anew

The counts are in `docs/reliability.json`: `faults` by `experiments.faults`, `fuzz` by `experiments.fuzz`, `checkpoints`
by this module.
"""

from __future__ import annotations

import argparse
import pathlib
import shutil
import sys
import tempfile
import textwrap
from collections.abc import Callable, Collection, Sequence
from typing import Any

from dipn_jax.commands import console, markdown
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine
from experiments import pages, promises

PAGE = "reliability"
"""Name of the page in docs and of its JSON."""


def section(values: dict[str, Any]) -> str:
    """Return the page's list of promises and its table of faults as Markdown, from its JSON."""
    paragraphs = [f"Tried: {'; '.join(each.counted(values) for each in promises.PROMISES if each.counted)}."]
    for promise in promises.PROMISES:
        paragraphs += [f"**{promise.text}**", f"Held by {', '.join(f'`{test}`' for test in promise.tests)}."]
        if promise.counted:
            paragraphs.append(f"Tried: {promise.counted(values)}.")
    wrapped = [textwrap.fill(each, 120, break_long_words=False, break_on_hyphens=False) for each in paragraphs]
    columns = ("tried", "lost", "repeated", "wrong", "damaged", "tracebacks")
    rows = []
    for case, kinds in promises.cases_of(values).items():
        for kind, row in kinds.items():
            rows.append([case, kind, *(str(row[name]) for name in columns)])
    return "\n\n".join([*wrapped, "## Faults by command", markdown.table(["command", "fault", *columns], rows)])


def box(values: dict[str, Any]) -> str:
    """Return the page's box as Markdown: machine, commit and seed of each count, from its JSON."""
    fuzzed: dict[str, list[str]] = {}
    for parser, found in values.get("fuzz", {}).items():
        about = f"commit {found['commit']}, seed {found['seed']}"
        fuzzed.setdefault(about, []).append(parser)
    lines = [f"{', '.join(parsers)}: {about}" for about, parsers in fuzzed.items()]
    if len(lines) == 1:
        lines = [f"inputs: {about}" for about in fuzzed]
    disturbed: dict[str, list[str]] = {}
    for case, made in values.get("faults", {}).get(pages.MADE, {}).items():
        disturbed.setdefault(_made(made), []).append(case)
    lines += [
        f"faults: {about}" if len(disturbed) == 1 else f"{', '.join(disturbed[about])}: {about}" for about in disturbed
    ]
    lines += [f"damaged: {_made(values['checkpoints'])}"] if "checkpoints" in values else []
    wrapped = [textwrap.fill(line, pages.BOX_WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in lines]
    return "\n".join(["```", *wrapped, "```"]) + "\n"


def _made(made: dict[str, Any]) -> str:
    return f"commit {made['commit']}, {made['processor']}"


def write(key: str, found: dict[str, Any], *, docs: pathlib.Path = pages.DOCS) -> None:
    """Put what an experiment found into `reliability.json` under its key, and its section into `reliability.md`."""
    path, page = docs / f"{PAGE}.json", docs / f"{PAGE}.md"
    values = (files.read_json(path) if path.exists() else {}) | {key: found}
    text = pages.with_box(pages.with_tables(files.read_text(page), section(values)), box(values))
    files.write_json(path, values)
    files.write_text(page, text)


def write_faults(
    found: dict[str, Any], made: dict[str, str], *, known: Collection[str], docs: pathlib.Path = pages.DOCS
) -> None:
    """Put counts of faults, by command and kind, beside those of other commands.

    Args:
      found: the counts.
      made: at which commit and on what processor they were made.
      known: names of all commands; what is said of others is left out.
      docs: folder of the page and of its JSON.
    """
    path = docs / f"{PAGE}.json"
    there = files.read_json(path).get("faults", {}) if path.exists() else {}
    by_name = {name: row for name, row in there.items() if name in known} | found
    by_commit = {name: one for name, one in there.get(pages.MADE, {}).items() if name in known}
    write("faults", by_name | {pages.MADE: by_commit | dict.fromkeys(found, made)}, docs=docs)


def _flip(path: pathlib.Path) -> None:
    content = bytearray(path.read_bytes())
    if content:
        content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content) or b"x")


def _cut(path: pathlib.Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if content else b"x")


def _zero(path: pathlib.Path) -> None:
    path.write_bytes(bytes(max(1, path.stat().st_size)))


WAYS: dict[str, Callable[[pathlib.Path], None]] = {
    "a bit flipped": _flip,
    "cut in half": _cut,
    "deleted": pathlib.Path.unlink,
    "zeros": _zero,
}
"""Ways to damage a file; one that is empty becomes longer."""


def damage(run: pathlib.Path, ways: Sequence[str] = tuple(WAYS)) -> dict[str, int]:
    """Damage every file of a run's newest step in every way, one at a time, and count after how many the run continues.

    Args:
      run: a run of GN with two steps; it is changed and mended again.
      ways: keys of WAYS.

    Returns:
      `damaged`, how often that was done, and `recovered`, how often the step before was loaded instead, by an
      evaluation and by a training that continues.
    """
    from dipn_jax.storage import checkpoint

    newest, before = sorted((run / "checkpoints").iterdir(), reverse=True)
    kept = run / "kept"
    shutil.copytree(newest, kept)
    wanted = checkpoint.digest(checkpoint.load_network(before, network="grasp")), before
    count = {"damaged": 0, "recovered": 0}
    for path in sorted(path for path in newest.rglob("*") if path.is_file()):
        for way in ways:
            WAYS[way](path)
            count["damaged"] += 1
            try:
                resumed = checkpoint.newest(run)
                found = checkpoint.digest(checkpoint.load_network(run, network="grasp")), resumed and resumed[0]
            except UserError:
                found = "", None
            count["recovered"] += found == wanted
            shutil.copy(kept / path.relative_to(newest), path)
    shutil.rmtree(kept)
    return count


def two_steps(run: pathlib.Path) -> None:
    """Write a run of a small GN with two steps, each with the state of its optimizer."""
    from dipn_jax.train.configs import TrainConfig
    from dipn_jax.train.optimizers import make_optimizer
    from flax import nnx

    from dipn_jax.networks.grasp import GraspConfig
    from dipn_jax.storage import checkpoint

    config = GraspConfig(width=8, coarse=8, blocks=1)
    for step in (1, 2):
        model = checkpoint.build("grasp", config, seed=step)
        moments = make_optimizer(TrainConfig(steps=2)).init(nnx.state(model, nnx.Param))
        parts = {"model": nnx.state(model), "train": moments}
        checkpoint.save(run, step, parts, network="grasp", config=config, extra={})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.reliability",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--dry-run", action="store_true", help="show the promises")
    options = parser.parse_args(arguments)
    return console.exit_code(lambda: _work(options))


def _work(options: argparse.Namespace) -> int:
    if options.dry_run:
        for promise in promises.PROMISES:
            console.say(promise.text)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        two_steps(pathlib.Path(folder))
        found = damage(pathlib.Path(folder))
    write("checkpoints", found | {"commit": machine.commit(), "processor": machine.processor()})
    console.say(f"checkpoints: {found['recovered']} of {found['damaged']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
