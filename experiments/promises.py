"""The promises of commands, each with the tests that fail where it is broken, and with the counts for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from experiments import pages


def cases_of(values: dict[str, Any]) -> dict[str, Any]:
    """Return the counts of faults by command and kind, from the page's JSON."""
    return {name: found for name, found in values.get("faults", {}).items() if name != pages.MADE}


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
    return f"{inputs:,} damaged inputs: {tracebacks:,} tracebacks"


def _checkpoints(values: dict[str, Any]) -> str:
    found = values.get("checkpoints")
    if not found:
        return "not run"
    return f"{found['damaged']} damaged checkpoints: {found['recovered']} runs continued with the step before"


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
            "tests/train/online/test_baseline.py::test_an_interrupted_run_continues_to_the_same_end",
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
        "Checkpoints of `push`, `grasp-pretrain` and `grasp` are written in the background: what training does "
        "meanwhile does not change them, the run waits for the last one, and a step that cannot be saved ends the run "
        "with one line and exit code 2. Trainings that act save after each round, before the next.",
        (
            f"{_STORAGE}/test_saving.py::test_what_is_donated_or_changed_while_a_step_is_written_does_not_change_it",
            f"{_STORAGE}/test_saving.py::test_one_step_is_written_at_a_time_and_the_last_is_waited_for",
            "tests/train/test_resuming.py::test_a_step_that_cannot_be_saved_ends_the_run_with_one_line",
        ),
    ),
    Promise(
        "A damaged shard is named, set aside by `dipn-datagen repair` and made again with the same bytes. One that a "
        "training finds when it first uses it ends the training with one line; the last checkpoint is whole.",
        (
            f"{_STORAGE}/test_records.py::test_a_damaged_shard_is_named_and_repaired",
            "tests/test_commands.py::test_a_truncated_shard",
            "tests/train/test_damaged.py::"
            "test_a_damaged_shard_ends_the_training_that_uses_it_and_what_was_saved_is_whole",
        ),
    ),
    Promise(
        "A damaged or malformed file from the user gives one line and exit code 2, not a traceback.",
        (
            "tests/experiments/test_fuzz.py::test_what_is_damaged_is_accepted_or_refused_with_one_line",
            "tests/test_commands.py::test_an_unknown_shape_in_a_case_file",
            "tests/dipn_jax/system/test_files.py::test_a_file_that_is_no_utf8_is_damaged",
        ),
        _fuzz,
    ),
    Promise(
        "A disk that is full or read-only gives one line and exit code 2, and nothing half-written has a final name.",
        (
            "tests/test_refused.py::test_a_folder_on_a_read_only_disk",
            "tests/test_refused.py::test_a_data_set_on_a_disk_that_became_read_only",
            f"{_STORAGE}/test_checkpoint.py::test_a_full_disk_is_one_line_and_leaves_no_litter",
            f"{_STORAGE}/test_space.py::test_a_disk_without_room_is_one_line",
            "tests/experiments/test_faults.py::test_a_command_given_again_after_a_fault_ends_as_an_undisturbed_one",
        ),
    ),
    Promise(
        "The folder of a training or an evaluation has one owner at a time; a second command stops and names it.",
        (
            f"{_STORAGE}/test_owner.py::test_the_second_is_told_who_has_it_and_a_dead_owner_does_not_block",
            "tests/train/test_loop.py::test_a_run_that_is_going_on_is_not_started_again",
            "tests/eval/test_one_owner.py::test_a_second_evaluation_into_a_folder_is_told_who_has_it",
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
        "When a node or a worker of a Ray cluster is lost, only its task is run again; data sets, evaluations and the "
        "weights of a sweep are those of one machine, byte for byte. (The tests are skipped where Ray is not "
        "installed.)",
        (
            "tests/datagen/test_shard_tasks.py::test_nodes_and_workers_that_are_lost_change_nothing",
            "tests/datagen/test_shard_tasks.py::test_a_driver_that_is_killed_goes_on_when_it_is_started_again",
            "tests/eval/workers/test_launching.py::test_a_cluster_that_loses_nodes_makes_the_evaluation_of_one_machine",
            "tests/test_on_cluster.py::test_a_sweep_whose_workers_are_killed_trains_the_networks_of_one_machine",
        ),
    ),
    Promise(
        "A machine of a Ray cluster whose file system fails does not end the job: its tasks are run again on another.",
        ("tests/dipn_jax/commands/test_launch.py::test_what_the_files_of_a_machine_do_is_tried_again_elsewhere",),
    ),
    Promise(
        "A training whose machine a Ray cluster has lost is tried again while the file system keeps the lost machine's "
        "lock on its folder, for up to eight minutes.",
        (
            "tests/dipn_jax/commands/test_launch.py::"
            "test_a_folder_that_a_lost_machine_has_is_tried_again_until_its_lock_has_gone",
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
        "process ends all of them with a checkpoint, from which any number of devices can continue. If one is killed, "
        "the others end, and the last checkpoint is whole. If one was given other data, all are told so at once.",
        (
            "tests/train/test_devices.py::test_four_devices_learn_what_one_does_and_one_goes_on_from_there",
            "tests/train/test_devices.py::test_a_process_that_is_killed_ends_the_others_and_nothing_saved_is_lost",
            "tests/train/test_devices.py::test_processes_with_other_data_are_told_so_before_anything_is_written",
        ),
    ),
    Promise(
        "Data sets are merged completely or not at all, and an interrupted merge or export continues to the same "
        "bytes; so does a merge into object storage, which replaces no shard that is there.",
        (
            "tests/datagen/test_merging.py::test_an_interrupted_merge_continues",
            "tests/datagen/test_joined.py::test_a_merge_that_is_killed_goes_on_and_racing_ones_create_each_shard_once",
            "tests/datagen/test_joined.py::test_what_is_there_of_somebody_else_stays_and_is_one_line",
            "tests/datagen/exporting/test_export.py::test_an_interrupted_export_ends_as_an_undisturbed_one",
        ),
    ),
    Promise(
        "Weights load on any device from any device. (Devices are imitated; it was not tried on a GPU yet.)",
        (
            f"{_STORAGE}/test_checkpoint.py::test_weights_load_on_another_device_than_saved_them",
            f"{_STORAGE}/test_checkpoint.py::test_random_keys_come_back_as_keys_on_another_device",
        ),
    ),
    Promise(
        "A loss or a weight that is not finite ends a training with one line, and the last finite checkpoint stays the "
        "newest.",
        (
            "tests/train/test_loop.py::test_a_loss_that_is_not_finite_ends_a_run_at_the_last_finite_checkpoint",
            "tests/train/test_loop.py::test_weights_that_overflow_are_not_saved",
            "tests/train/test_starting.py::test_learning_online_stops_at_a_loss_that_is_not_finite",
            "tests/train/online/test_baseline.py::test_a_loss_that_is_not_finite_ends_a_run_with_one_line",
        ),
    ),
    Promise(
        "SIGINT, SIGTERM, SIGHUP and SIGUSR1 save and end work alike, also where one arrives in a callback of JAX.",
        (
            "tests/dipn_jax/system/test_interruption.py::"
            "test_a_signal_lets_the_current_step_end_and_interrupts_the_command",
            "tests/dipn_jax/system/test_interruption.py::test_a_signal_within_a_callback_is_not_lost",
        ),
    ),
    Promise(
        "Nothing is unpickled, and no name in a file leads out of its folder.",
        (
            "tests/test_house.py::test_nothing_is_pickled",
            f"{_STORAGE}/test_damaged.py::test_no_name_in_a_manifest_leads_out_of_the_folder",
        ),
    ),
    Promise(
        "What a data set lacks of what was asked for is said, with the command that makes it, and so is who made it.",
        (
            f"{_STORAGE}/test_accounting.py::test_what_is_missing_is_said_with_what_fills_it",
            f"{_STORAGE}/test_accounting.py::test_everybody_who_made_shards_is_listed_and_a_mix_is_said",
        ),
    ),
    Promise(
        "An episode can be simulated again from its record: by `native` exactly.",
        ("tests/datagen/test_replay.py::test_what_is_replayed_is_what_is_stored_to_the_last_bit",),
    ),
    Promise(
        "What a camera says wrongly is refused in one line before anything is computed.",
        (
            "tests/dipn_jax/sight/test_observed.py::test_what_no_network_can_judge_is_refused_in_one_line",
            "tests/dipn_jax/sight/test_observed.py::test_what_decides_and_imagines_refuses_it_too",
        ),
    ),
    Promise(
        "A device that is not there is one line, a container's quota of cores is heeded, and a forked process reads "
        "data but is refused where it would hang.",
        (
            "tests/test_commands.py::test_a_device_that_is_not_there_is_one_line",
            "tests/dipn_jax/system/test_machine.py::test_a_containers_quota_is_heeded",
            "tests/dipn_jax/system/test_forking.py::test_forked_workers_read_and_spawned_ones_render",
        ),
    ),
)
"""What runs promise, the tests that fail where it is broken, and what was counted."""
