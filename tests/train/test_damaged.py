"""A shard that turns out to be damaged when a training first uses it ends the training with one line."""

import pathlib
import threading

import numpy as np
import pyarrow.parquet as pq
import pytest
from dipn_jax.train import example_order
from dipn_jax.train.loop import TrainConfig, fit
from dipn_jax.train.push import PushTask

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.storage import checkpoint, manifest, records, shards

PLAN = TrainConfig(steps=6, batch=1, eval_every=4, save_every=1)


@pytest.fixture
def folder(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> pathlib.Path:
    """Return a data set of pushes that has one scene, four pushes, in each of its six shards; the last is held out."""
    made = tmp_path / "data"
    made.mkdir()
    found = structs.concatenate([shards.read_shard(path, kind="push") for path in shards.shard_files(data["push"])])
    for number in range(6):
        some = structs.take(found, slice(4 * number, 4 * number + 4))
        shards.write_shard(made, number, some, kind="push", config={}, faults={})
    manifest.update_manifest(made)
    return made


def _damage(path: pathlib.Path) -> None:
    """Change a byte of the poses in a shard, and list it as it is then."""
    content, columns = bytearray(path.read_bytes()), pq.ParquetFile(path).metadata.row_group(0)
    found = [columns.column(number) for number in range(columns.num_columns)]
    poses = next(column for column in found if column.path_in_schema.startswith("poses."))
    content[poses.data_page_offset + poses.total_compressed_size - 8] ^= 1
    path.write_bytes(content)
    (path.parent / manifest.MANIFEST).unlink()
    manifest.update_manifest(path.parent)
    assert records.verify(path.parent) == []


@pytest.mark.parametrize("held_out", [False, True])
def test_a_damaged_shard_ends_the_training_that_uses_it_and_what_was_saved_is_whole(
    held_out: bool, folder: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that is learnt from is read by the thread that fetches ahead; those that are held out, when it evaluates."""
    seen = np.concatenate([np.asarray(example_order.batches((20,), PLAN)[step]) // 4 for step in range(PLAN.steps)])
    fatal = next(step for step in range(2, PLAN.steps) if seen[step] not in seen[:step])
    damaged = shards.shard_path(folder, 5 if held_out else int(seen[fatal]))
    _damage(damaged)
    task = PushTask(folder, DipnConfig(width=8), limit=None, centimetres=(5, 10))
    assert task.size == 20
    out = tmp_path / "run"
    assert console.exit_code(lambda: bool(fit(task, PLAN, out)) and 0) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("train dipn: ")]
    assert said == [f"error: shard {damaged}: truncated, damaged or not Parquet; run dipn-datagen repair {folder}"]
    found = checkpoint.newest(out)
    assert found and found[1]["step"] == (PLAN.eval_every - 1 if held_out else fatal)
    checkpoint.load_network(out, network="dipn")
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("batches")]
