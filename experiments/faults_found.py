"""What a command has made in a folder, held against what an undisturbed run makes."""

from __future__ import annotations

import collections
import dataclasses
import hashlib
import pathlib
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import pyarrow.parquet as pq

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.storage import checkpoint, records
from dipn_jax.system import files

WRITTEN_ONCE = ("metrics.json", "part.json", "info.json", "stats.json", "README.md")
"""Names of files that have their last content when they get their name, as shards, films and tables have."""


@dataclasses.dataclass(frozen=True)
class Result:
    """What a command has made: its records, in order, and a digest of every result that must not differ."""

    records: list[str]
    digests: dict[str, str]


def result(out: pathlib.Path) -> Result:
    """Return what a finished command has made in a folder: a data set, an export, a run, an evaluation or part of one.

    Raises:
      UserError: something in it is damaged.
    """
    if (out / "manifest.json").exists():
        episodes: Any = records.read_episodes(out)
        rows = [structs.take(episodes, i) for i in range(len(episodes.fault))]
        names = ("config.json", "manifest.json", *(path.name for path in out.glob("shard-*")))
        return Result([_digest(row) for row in rows], {name: files.file_sha256(out / name) for name in names})
    if (out / "checkpoints").exists():
        found = checkpoint.newest(out)
        if found is None:
            raise UserError(f"{out}: no whole step")
        folder, meta = found
        arrays = {name: _digest(arrays_of(folder / name)) for name in ("model", "train") if (folder / name).exists()}
        lines = files.read_text(out / "metrics.jsonl").splitlines()
        plain = {key: value for key, value in meta.items() if key != "sha256"}
        return Result(lines, arrays | {"meta": repr(sorted(plain.items())), "metrics": "\n".join(lines)})
    return Result(_rows(out), tree(out))


def tree(folder: pathlib.Path) -> dict[str, str]:
    """Return the SHA-256 of every file in a folder and below it, but for its owner and its lock, by relative name."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    names = [str(path.relative_to(folder)) for path in paths if not path.name.startswith(("owner", ".lock"))]
    return {name: files.file_sha256(folder / name) for name in names}


def _rows(out: pathlib.Path) -> list[str]:
    """Return the records of an export or of an evaluation, in order.

    Raises:
      UserError: there are none, or a file with some is damaged.
    """
    if (out / "episodes.json").exists():  # tables that were cleared
        return [repr(entry) for entry in files.read_json(out / "episodes.json", wanted=list)]
    if (out / "errors.npz").exists():  # pushes that were predicted
        with np.load(out / "errors.npz", allow_pickle=False) as errors:
            return [_digest(row) for row in zip(*(errors[name] for name in sorted(errors)), strict=True)]
    if tables := sorted((out / "data").rglob("*.parquet")):
        return [repr(row) for table in tables for row in pq.read_table(table).to_pylist()]
    if groups := sorted(out.glob("*.zarr")):
        return [row for group in groups for row in _episodes_of_zarr(group)]
    return [repr(number) for number in sorted(files.read_json(out / "metrics.json").items())]


def _episodes_of_zarr(path: pathlib.Path) -> list[str]:
    """Return a digest of each episode of a group, from its row of every array in `meta` and its steps in `data`."""
    import zarr

    group: Any = zarr.open_group(path, mode="r", zarr_format=2)
    meta, steps = ({name: group[of][name][:] for name in sorted(group[of])} for of in ("meta", "data"))
    ends = [0, *meta["episode_ends"].tolist()]
    return [
        _digest(
            [[array[row] for array in meta.values()], [array[ends[row] : ends[row + 1]] for array in steps.values()]]
        )
        for row in range(len(ends) - 1)
    ]


def arrays_of(part: pathlib.Path) -> dict[str, np.ndarray]:
    """Return the arrays of one part of a step, `STEP/model` or `STEP/train`, by their names in the order of these."""
    checkpointer = ocp.PyTreeCheckpointer()
    names = sorted(checkpointer.metadata(part.resolve()).item_metadata.tree)
    as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in names}
    found = checkpointer.restore(part.resolve(), restore_args=as_numpy)
    return {name: found[name] for name in names}


def _digest(tree: Any) -> str:
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()


def damaged(out: pathlib.Path, whole: Result) -> list[str]:
    """Return what has its final name after a fault, and is not as an undisturbed run makes it or cannot be read."""
    wrong = []
    for name in whole.digests:
        path = out / name
        written_once = path.suffix in (".parquet", ".npz") or path.name in WRITTEN_ONCE
        if written_once and path.exists() and files.file_sha256(path) != whole.digests[name]:
            wrong.append(name)
    for path in [*out.glob("*.json"), *out.glob("meta/*.json")]:
        if not path.name.startswith("owner"):
            try:
                files.read_json(path, wanted=object)
            except UserError:
                wrong.append(path.name)
    steps = out / "checkpoints"
    for folder in steps.iterdir() if steps.is_dir() else []:
        if folder.name.isdigit() and checkpoint.newest(folder) is None:
            wrong.append(f"checkpoints/{folder.name}")
    return wrong


def compare(found: Result, whole: Result) -> dict[str, int]:
    """Return how many records are lost and repeated, and whether anything differs from an undisturbed run's."""
    here, there = collections.Counter(found.records), collections.Counter(whole.records)
    repeated = sum(max(0, here[record] - there[record]) for record in here if record in there)
    wrong = found.digests != whole.digests
    return {"lost": (there - here).total(), "repeated": repeated, "wrong": int(wrong)}
