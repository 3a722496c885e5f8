"""The manifest is a function of the shards: a data set that it does not list, or not all of it, is read as well."""

import json
import pathlib
import shutil

import pytest
from dipn_jax.datagen import upkeep

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import manifest, records, shards
from dipn_jax.storage.manifest import MANIFEST, update_manifest


@pytest.fixture
def copy(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> pathlib.Path:
    return pathlib.Path(shutil.copytree(data["push"], tmp_path / "push"))


def _unlist(folder: pathlib.Path, *, all_of_it: bool) -> None:
    """Let a data set be as a generation leaves it that is killed: without a manifest, or with one of fewer shards."""
    if all_of_it:
        (folder / MANIFEST).unlink()
    else:
        listed = json.loads((folder / MANIFEST).read_text())
        del listed["shards"]["shard-00001.parquet"]
        (folder / MANIFEST).write_text(json.dumps(listed))


@pytest.mark.parametrize("all_of_it", [True, False])
def test_a_killed_generation_is_read_as_far_as_it_came(
    copy: pathlib.Path, all_of_it: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, fingerprint = records.load(copy, kind="push")
    about, written = records.summary(copy), (copy / MANIFEST).read_bytes()
    _unlist(copy, all_of_it=all_of_it)
    upkeep.verify(copy)
    upkeep.info(copy)
    assert records.summary(copy) == about and records.missing(copy) is None
    again, same = records.load(copy, kind="push")
    assert same == fingerprint and (again.poses == whole.poses).all()
    assert capsys.readouterr().err == ""
    update_manifest(copy)
    assert (copy / MANIFEST).read_bytes() == written, "it is a function of the shards"


def test_what_a_killed_generation_did_not_make_is_missing(
    copy: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shards.shard_path(copy, 0).unlink()
    _unlist(copy, all_of_it=True)
    said = f"{copy}: 8 of 24 episodes, shard 0 missing: run the command that made it again"
    assert records.verify(copy) == [] and records.missing(copy) == records.summary(copy)["missing"] == said
    assert len(records.load(copy, kind="push")[0].fault) == 8
    assert capsys.readouterr().err == f"warning: {said}\n"
    shards.shard_path(copy, 1).unlink()
    with pytest.raises(UserError, match="no shards; generate some"):
        records.load(copy, kind="push")


@pytest.mark.parametrize("at", [100, None])
def test_a_damaged_shard_that_is_not_listed_is_named_and_set_aside(copy: pathlib.Path, at: int | None) -> None:
    """Its numbers carry checksums."""
    path = shards.shard_path(copy, 1)
    content = bytearray(path.read_bytes())
    if at is None:
        del content[200:]
    else:
        content[at] ^= 255
    path.write_bytes(content)
    _unlist(copy, all_of_it=False)
    ((named, _),) = records.verify(copy)
    assert named == path
    assert console.exit_code(lambda: upkeep.verify(copy)) == 2
    with pytest.raises(UserError, match=r"shard-00001\.parquet.*repair"):
        records.load(copy, kind="push")
    assert [set_aside.name for set_aside in records.repair(copy)] == [path.name]
    assert len(records.load(copy, kind="push")[0].fault) == 16


def test_a_shard_that_is_forgotten_is_read_as_it_is(copy: pathlib.Path) -> None:
    """One that was about to be made anew, when generation was killed, may be the old or the new one."""
    before, name = (copy / MANIFEST).read_bytes(), "shard-00001.parquet"
    manifest.forget(copy, {"shard-00007.parquet"})
    assert (copy / MANIFEST).read_bytes() == before, "nothing of it is listed"
    manifest.forget(copy, {name})
    assert list(manifest.listed(copy)) == ["shard-00000.parquet"] and list(manifest.entries(copy))[1] == name
    episodes = shards.read_shard(copy / name, kind="push")
    made = shards.write_shard(copy, 1, episodes, kind="push", config={"seed": 8}, faults={})
    assert records.verify(copy) == [] and manifest.entries(copy)[name] == made


def test_an_entry_that_is_given_is_not_read_again(copy: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, made = (copy / MANIFEST).read_bytes(), manifest.entries(copy)
    (copy / MANIFEST).unlink()
    monkeypatch.setattr(shards, "entry", lambda path: pytest.fail(f"{path} is read"))
    update_manifest(copy, made=made)
    assert (copy / MANIFEST).read_bytes() == before
