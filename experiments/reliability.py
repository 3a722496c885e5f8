"""The page of what runs survive: promises, the tests that hold them, and counts of what was tried.

    python -m experiments.reliability             # damages a checkpoint in every way and writes the page anew

The counts are in `docs/reliability.json`: `faults` by `experiments.faults`, `fuzz` by `experiments.fuzz`, `checkpoints`
by this module.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import shutil
import sys
import tempfile
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

from dipn_jax.commands import console, markdown
from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments import pages

PAGE = "reliability"
"""Name of the page in docs and of its JSON."""


@dataclasses.dataclass(frozen=True)
class Promise:
    """Something that a user can rely on."""

    text: str
    tests: tuple[str, ...]  # file::name
    counted: Callable[[dict[str, Any]], str] | None = None  # what was tried, from the page's JSON


def _faults(values: dict[str, Any]) -> str:
    rows = [row for case in cases_of(values).values() for row in case.values()]
    if not rows:
        return "not run"
    total = {name: sum(row[name] for row in rows) for name in rows[0]}
    return (
        f"{total['tried']} faults: {total['lost']} records lost, {total['repeated']} repeated, {total['wrong']} "
        f"results wrong, {total['damaged']} files damaged, {total['tracebacks']} tracebacks"
    )


def _fuzz(values: dict[str, Any]) -> str:
    found = values.get("fuzz", {}).values()
    if not found:
        return "not run"
    inputs, tracebacks = (sum(each[name] for each in found) for name in ("inputs", "tracebacks"))
    return f"{inputs:,} inputs: {tracebacks:,} tracebacks"


def _checkpoints(values: dict[str, Any]) -> str:
    found = values.get("checkpoints")
    return f"{found['damaged']} damaged: {found['recovered']} runs went on with the step before" if found else "not run"


_STORAGE = "tests/dipn_jax/storage"
PROMISES = (
    Promise(
        "A command that is killed, or whose disk is full, loses no finished record; the same command, given again, "
        "ends as if nothing had happened.",
        (
            "tests/experiments/test_faults.py::test_a_command_given_again_after_a_fault_ends_as_an_undisturbed_one",
            "tests/datagen/test_generate.py::test_a_gap_is_filled_with_the_same_bytes_and_the_rest_left_alone",
        ),
        _faults,
    ),
    Promise(
        "A file or step under its final name is complete, even after a power cut: its content is synced, then it is "
        "renamed, then the folder is synced.",
        (
            "tests/dipn_jax/system/test_files.py::test_content_is_synced_before_a_rename_and_the_name_after_it",
            "tests/test_house.py::test_files_are_renamed_in_one_place",
            f"{_STORAGE}/test_saving.py::test_a_step_has_its_name_only_when_it_is_synced",
        ),
    ),
    Promise(
        "On a CPU, a training that was stopped and continued ends bit for bit as one that was never stopped.",
        (
            "tests/train/test_resuming.py::test_an_interrupted_run_ends_as_an_uninterrupted_one",
            "tests/train/test_loop.py::test_learning_online_continues_where_it_was_stopped",
            "tests/train/test_baseline.py::test_an_interrupted_run_continues_to_the_same_end",
        ),
    ),
    Promise(
        "A damaged step of a run is noticed and named, and the step before it is used.",
        (
            f"{_STORAGE}/test_checkpoint.py::test_a_damaged_step_is_skipped",
            f"{_STORAGE}/test_checkpoint.py::test_a_damaged_newest_step_is_named_once_with_the_step_used",
            "tests/experiments/test_reliability.py::test_every_kind_of_damage_is_noticed",
        ),
        _checkpoints,
    ),
    Promise(
        "Checkpoints are written in the background: what training does meanwhile does not change them, the run waits "
        "for the last one, and a step that cannot be saved ends the run with one line and exit code 2.",
        (
            f"{_STORAGE}/test_saving.py::test_what_is_donated_or_changed_while_a_step_is_written_does_not_change_it",
            f"{_STORAGE}/test_saving.py::test_one_step_is_written_at_a_time_and_the_last_is_waited_for",
            "tests/train/test_resuming.py::test_a_step_that_cannot_be_saved_ends_the_run_with_one_line",
        ),
    ),
    Promise(
        "A damaged shard is named, set aside by `dipn-datagen repair` and made again with the same bytes.",
        (
            f"{_STORAGE}/test_records.py::test_a_damaged_shard_is_named_and_repaired",
            "tests/test_commands.py::test_a_truncated_shard",
        ),
    ),
    Promise(
        "A damaged or malformed file from the user gives one line and exit code 2, not a traceback.",
        (
            "tests/test_commands.py::test_an_unknown_shape_in_a_case_file",
            "tests/dipn_jax/system/test_files.py::test_a_file_that_is_no_utf8_is_damaged",
        ),
        _fuzz,
    ),
    Promise(
        "The folder of a training or an evaluation has one owner at a time; a second command stops and names it.",
        (
            f"{_STORAGE}/test_owner.py::test_the_second_is_told_who_has_it_and_a_dead_owner_does_not_block",
            "tests/train/test_loop.py::test_a_run_that_is_going_on_is_not_started_again",
            "tests/eval/test_owned.py::test_a_second_evaluation_into_a_folder_is_told_who_has_it",
        ),
    ),
    Promise(
        "On a file system without locks, data sets are still made, runs trained and tables cleared, with one line of "
        "warning.",
        (
            "tests/datagen/test_generate.py::test_without_locks_a_data_set_is_made_all_the_same_with_one_line",
            f"{_STORAGE}/test_records.py::"
            "test_without_locks_a_shard_that_comes_while_the_manifest_is_written_is_listed",
            f"{_STORAGE}/test_owner.py::test_without_locks_the_file_is_made_exclusively_and_that_is_said",
        ),
    ),
    Promise(
        "When a node or a worker of a Ray cluster is lost, only its task is run again; data sets and evaluations are "
        "those of one machine, byte for byte. (The tests are skipped where Ray is not installed.)",
        (
            "tests/datagen/test_spread.py::test_nodes_and_workers_that_are_lost_change_nothing",
            "tests/eval/test_shares.py::test_parts_make_the_very_evaluation_of_one_worker",
        ),
    ),
    Promise(
        "In object storage each shard is kept once, however many workers make it, and a worker that is killed leaves "
        "complete shards only; the next worker completes the data set to that of one machine, byte for byte.",
        (
            "tests/datagen/test_object_storage.py::"
            "test_racing_writers_make_each_shard_once_and_a_killed_ones_work_goes_on",
            f"{_STORAGE}/test_objects.py::test_of_racing_writers_one_wins",
            f"{_STORAGE}/test_places.py::test_a_shard_that_another_has_made_stays_and_is_listed_as_it_is",
        ),
    ),
    Promise(
        "A training shared by devices or processes learns what one device learns, up to rounding; interrupting one "
        "process ends all of them with a checkpoint, from which any number of devices can continue.",
        ("tests/train/test_devices.py::test_four_devices_learn_what_one_does_and_one_goes_on_from_there",),
    ),
    Promise(
        "Data sets are merged completely or not at all, and an interrupted export continues to the same bytes.",
        (
            "tests/datagen/test_merging.py::test_an_interrupted_merge_continues",
            "tests/datagen/exporting/test_export.py::test_an_interrupted_export_ends_as_an_undisturbed_one",
        ),
    ),
)
"""What runs promise, the tests that fail where it is broken, and what was counted."""


def cases_of(values: dict[str, Any]) -> dict[str, Any]:
    """Return the counts of faults by command and kind, from the page's JSON."""
    return {name: found for name, found in values.get("faults", {}).items() if name != pages.MADE}


def section(values: dict[str, Any]) -> str:
    """Return the page's list of promises and its table of faults as Markdown, from its JSON."""
    paragraphs = []
    for promise in PROMISES:
        paragraphs += [f"**{promise.text}**", f"Held by {', '.join(f'`{test}`' for test in promise.tests)}."]
        if promise.counted:
            paragraphs.append(f"Tried: {promise.counted(values)}.")
    wrapped = [textwrap.fill(each, 120, break_long_words=False, break_on_hyphens=False) for each in paragraphs]
    columns = ("tried", "lost", "repeated", "wrong", "damaged", "tracebacks")
    rows = []
    for case, kinds in cases_of(values).items():
        for kind, row in kinds.items():
            rows.append([case, kind, *(str(row[name]) for name in columns)])
    return "\n\n".join([*wrapped, "## Faults by command", markdown.table(["command", "fault", *columns], rows)])


def write(key: str, found: dict[str, Any], *, docs: pathlib.Path = pages.DOCS) -> None:
    """Put what an experiment found into `reliability.json` under its key, and its section into `reliability.md`."""
    path, page = docs / f"{PAGE}.json", docs / f"{PAGE}.md"
    values = (files.read_json(path) if path.exists() else {}) | {key: found}
    text = pages.with_tables(files.read_text(page), section(values))
    files.write_json(path, values)
    files.write_text(page, text)


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
    """Damage every file of a run's newest step in every way, one at a time, and count after how many the run goes on.

    Args:
      run: a run of GN with two steps; it is changed and mended again.
      ways: keys of WAYS.

    Returns:
      `damaged`, how often that was done, and `recovered`, how often the step before was loaded instead.
    """
    from dipn_jax.storage import checkpoint

    newest, before = sorted((run / "checkpoints").iterdir(), reverse=True)
    kept = run / "kept"
    shutil.copytree(newest, kept)
    wanted = checkpoint.digest(checkpoint.load_network(before, network="grasp"))
    count = {"damaged": 0, "recovered": 0}
    for path in sorted(path for path in newest.rglob("*") if path.is_file()):
        for way in ways:
            WAYS[way](path)
            count["damaged"] += 1
            try:
                found = checkpoint.digest(checkpoint.load_network(run, network="grasp"))
            except UserError:
                found = ""
            count["recovered"] += found == wanted
            shutil.copy(kept / path.relative_to(newest), path)
    shutil.rmtree(kept)
    return count


def two_steps(run: pathlib.Path) -> None:
    """Write a run of a small GN with two steps."""
    from flax import nnx

    from dipn_jax.networks.grasp import GraspConfig
    from dipn_jax.storage import checkpoint

    config = GraspConfig(width=8, coarse=8, blocks=1)
    for step in (1, 2):
        parts = {"model": nnx.state(checkpoint.build("grasp", config, seed=step))}
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
        for promise in PROMISES:
            console.say(promise.text)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        two_steps(pathlib.Path(folder))
        write("checkpoints", found := damage(pathlib.Path(folder)))
    console.say(f"checkpoints: {found['recovered']} of {found['damaged']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
