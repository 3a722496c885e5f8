"""The parsers that a user's files reach, each with a valid file and with what reads it, for `fuzz` and for tests."""

from __future__ import annotations

import copy
import dataclasses
import functools
import json
import pathlib
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np
from dipn_jax.eval import curves, metrics
from dipn_jax.eval.clearing import film
from dipn_jax.eval.clearing.instances import Instance
from dipn_jax.eval.report import comparison
from dipn_jax.eval.workers import merging, shares
from dipn_jax.train import loop
from dipn_jax.train.configs import TrainConfig
from dipn_jax.train.example_store import ExampleStore

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.storage import checkpoint, records, resume, shards
from dipn_jax.storage.manifest import MANIFEST, update_manifest
from dipn_jax.storage.space import Space
from dipn_jax.system import files
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import cases
from experiments import fuzzing, runs
from experiments.fuzz_data import CONFIG, data_set, episodes

TRAINING = TrainConfig(steps=10, batch=2, eval_every=5, save_every=5)
"""The configuration of a training."""
FRESH = object()
"""A state that stands for none."""


@dataclasses.dataclass(frozen=True)
class Parser:
    """A parser, a valid file for it, and how that is mutated."""

    name: str
    file: str  # in a folder
    prepare: Callable[[pathlib.Path], None]  # writes the file, and what has to be beside it
    read: Callable[[pathlib.Path], Any]  # of the folder
    mutate: fuzzing.Mutate


def _look_at_data(folder: pathlib.Path) -> None:
    """Look at a data set in every way; raise the first error if it is refused in one of them."""
    problems: list[UserError] = []
    looks = (records.verify, records.missing, records.summary, functools.partial(records.load, kind="push"))
    for look in looks:
        try:
            look(folder)
        except UserError as error:
            problems.append(error)
    if problems:
        raise problems[0]


def _repair(folder: pathlib.Path) -> None:
    """Repair a copy of a data set, after which it is whole."""
    copied = folder / "copy"
    shutil.rmtree(copied, ignore_errors=True)
    copied.mkdir()
    for name in ("shard-00000.parquet", "config.json"):
        shutil.copy(folder / name, copied / name)
    try:
        read = shards.read_shard(copied / "shard-00000.parquet", kind="push")
    except UserError:
        read = None
    records.repair(copied)
    assert not records.verify(copied), "what was repaired is whole"
    assert read is None or records.load(copied, kind="push"), "what can be read is kept"


@functools.lru_cache(maxsize=1)
def _state(folder: pathlib.Path) -> resume.Partial:
    """Return what loads and saves a state; to make it, all sources are read."""
    return resume.Partial(folder, {"seed": 0})


def _table() -> Instance:
    """Return a table that was cleared by one push and one grasp."""
    one = structs.take(episodes("images", count=1), 0)
    step = {
        "shape": np.asarray(one.scene.shape),
        "poses": np.asarray(one.poses),
        "push": np.zeros(4, np.float32),
        "grasp": np.zeros(3, np.int32),
        "values": np.zeros(3, np.float32),
        "motion": np.zeros((3, 3), np.float32),
        "label": film.packed(np.zeros((WORKSPACE.pixels, WORKSPACE.pixels), np.int8)),
        "missed": np.zeros((4, 3), np.float32),
    }
    table = Instance("a", one.scene, np.asarray(one.poses), 3, grasps=1, pushes=1, removed=3, held=1, ended="cleared")
    table.did, table.film = ["push", "grasp held"], [step, copy.deepcopy(step)]
    return table


def _save_state(folder: pathlib.Path) -> None:
    state = (1, [_table()], {"x": [np.float32(0.1)], ("t", 2): None}, float("inf"), "é")
    _state(folder).save(state)


def _load_state(folder: pathlib.Path) -> None:
    """Load a state; one that is not taken up is refused, with a line on standard error."""
    if _state(folder).load(FRESH) is FRESH:
        raise UserError("begins anew")


def _save_cleared(folder: pathlib.Path) -> None:
    from dipn_jax.eval.clearing import lockstep

    tables = [_table()]
    lockstep.save(tables, folder)
    settings = {"method": "gn", "label": "", "tables.cases": "hard", "tables.objects": "10"}
    metrics.write(folder, lockstep.summary(tables), settings=settings)


def _report(folder: pathlib.Path) -> None:
    """Read what a report reads of a clearing, and make its tables, without drawing."""
    one = comparison.Cleared(folder)
    comparison.flat([one])
    comparison.share_left(one, np.linspace(0, 3, 4))
    comparison.results_and_causes([one])


def _save_part(folder: pathlib.Path) -> None:
    """Write an evaluation of one table as its only part."""
    _save_cleared(folder)
    names = ["episodes.json", "episodes/000.npz"]
    given = files.read_json(folder / "settings.json")
    share, words = shares.Share(0, 1), ["--method", "gn"]
    shares.write(
        folder, "clear", share, total=1, command=words, given=given, partial=_state(folder), names=names, about={}
    )


def _merge_part(folder: pathlib.Path) -> None:
    """Put the part together with no other, and read the whole as a report does."""
    part = shares.read(folder)
    merging.check([part])
    merging.write([part], folder / "whole")
    _report(folder / "whole")


def _network(folder: pathlib.Path) -> None:
    """Copy the network that comes with the package."""
    shutil.copytree(checkpoint.find(pathlib.Path("builtin"), network="grasp"), folder, dirs_exist_ok=True)


@functools.cache
def _loaded(folder: pathlib.Path, config: str) -> str:
    """Return why a network of this config is refused; an empty text if it is loaded."""
    try:
        checkpoint.load_network(folder, network="grasp")
    except UserError as error:
        return str(error)
    return ""


def _load_network(folder: pathlib.Path) -> None:
    """Load a network; where one of this config was loaded before, only its metadata, for the rest takes long."""
    found = checkpoint.newest(folder)
    if found is None or found[1]["network"] != "grasp":
        checkpoint.load_network(folder, network="grasp")
    elif refused := _loaded(folder, json.dumps(found[1]["network_config"])):
        raise UserError(refused)


def _log(folder: pathlib.Path) -> None:
    (folder / "config.json").write_text('{"pretrained": true}', encoding="utf-8")
    lines = (f'{{"step": {10 * n}, "success": 0.{n}}}' for n in range(1, 5))
    (folder / "metrics.jsonl").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _stamp(folder: pathlib.Path) -> None:
    runs.write_stamp(_run(folder), "key", complete=True)


def _run(folder: pathlib.Path) -> runs.Run:
    return runs.Run("a", folder, ("dipn-eval", "clear"))


def _parsers() -> list[Parser]:
    step = next(checkpoint.find(pathlib.Path("builtin"), network="grasp").glob("checkpoints/*"))
    tree, table, lines = fuzzing.mutate_json, fuzzing.mutate_parquet, fuzzing.mutate_lines
    return [
        Parser("case file", "c.json", _copy_cases, lambda at: cases.load_cases(at / "c.json"), tree),
        Parser("configuration", "config.json", data_set, _configuration, tree),
        Parser("command kept", "asked.json", data_set, _missing, tree),
        Parser("manifest", "manifest.json", data_set, _look_at_data, tree),
        Parser("shard", "shard-00000.parquet", _one_shard, _look_at_shard, table),
        Parser("grasps", "shard-00000.parquet", functools.partial(_one_shard, kind="grasp"), _look_at_grasps, table),
        Parser("repair", "shard-00000.parquet", _one_shard, _repair, table),
        Parser("checkpoint", f"checkpoints/{step.name}/meta.json", _network, _load_network, tree),
        Parser("state", "partial.npz", _save_state, _load_state, fuzzing.mutate_arrays),
        Parser("film", "episodes/000.npz", _save_cleared, _film, fuzzing.mutate_arrays),
        Parser("episodes", "episodes.json", _save_cleared, _report, tree),
        Parser("part", shares.PART, _save_part, _merge_part, tree),
        Parser("settings", "settings.json", _save_cleared, _report, tree),
        Parser("metrics", "metrics.json", _save_cleared, _report, tree),
        Parser("log", "metrics.jsonl", _log, lambda at: curves.load_grasp_runs([at]), lines),
        Parser("training", "config.json", _begin_training, _continue_training, tree),
        Parser("examples", "state.json", _keep_examples, _keep_examples, tree),
        Parser("stamp", runs.STAMP, _stamp, lambda at: runs.is_complete(_run(at), "key"), tree),
    ]


def _copy_cases(folder: pathlib.Path) -> None:
    """Write a case file: one of the shipped cases, without most of its objects."""
    case = files.read_json(cases.hard_cases_path())["cases"][0]
    files.write_json(folder / "c.json", {"cases": [case | {"objects": case["objects"][:2]}]})


def _configuration(folder: pathlib.Path) -> None:
    """Read a configuration as `accounting` reads it, and as a command that continues the data set does."""
    records.missing(folder)
    begun = files.read_json(folder / "config.json")
    files.claim(folder, {**CONFIG, "episodes": begun["episodes"]}, free=("episodes",))


def _missing(folder: pathlib.Path) -> None:
    """Say what is missing, on one line."""
    said = records.missing(folder)
    assert said and "\n" not in said


def _one_shard(folder: pathlib.Path, kind: str = "push") -> None:
    data_set(folder, kind=kind, number=1)


def _look_at_grasps(folder: pathlib.Path) -> None:
    _look_at_shard(folder, kind="grasp")


def _begin_training(folder: pathlib.Path) -> None:
    """Write the configuration of a training."""
    loop._claim(folder, dataclasses.asdict(TRAINING), TRAINING)


def _continue_training(folder: pathlib.Path) -> None:
    """Read the configuration as the command that continues the training does."""
    loop._claim(folder, dataclasses.asdict(TRAINING), TRAINING, write=False)


def _keep_examples(folder: pathlib.Path) -> None:
    """Take up examples that are kept in files, or make them anew, and close them."""
    kept = ExampleStore(lambda rows: {"x": np.asarray(rows, np.float32)}, 3, space=Space(0, folder), about="numbers")
    assert kept.take(np.arange(3))["x"].tolist() == [0, 1, 2]
    kept.close()


def _look_at_shard(folder: pathlib.Path, kind: str = "push") -> None:
    """Read a shard, and list it in a manifest."""
    (folder / MANIFEST).unlink(missing_ok=True)
    shards.read_shard(folder / "shard-00000.parquet", kind=kind)
    update_manifest(folder)
    records.summary(folder)


def _film(folder: pathlib.Path) -> None:
    film.load(folder / "episodes" / "000.npz")


PARSERS: dict[str, Parser] = {parser.name: parser for parser in _parsers()}
"""The parsers by name."""
