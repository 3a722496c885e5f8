"""Data sets that are joined in object storage are those that are joined in a folder."""

import pathlib
import shutil
import subprocess
import sys
from typing import Any

import pytest
from dipn_jax.datagen import cli

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.storage import manifest, records, shards
from dipn_jax.storage.objects import Bucket
from dipn_jax.system import files

SHARDS = 5
"""Shards of the two data sets that are joined."""


def merge(*words: object) -> int:
    return console.run("dipn-datagen", cli.COMMANDS, ["merge", *map(str, words)])


def _bytes(folder: pathlib.Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*")}


@pytest.fixture
def sets(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[pathlib.Path, pathlib.Path]:
    """Return two data sets, of three shards and of two."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    episodes: Any = records.read_episodes(data["push"])
    folders = (tmp_path / "one", tmp_path / "two")
    for seed, (folder, numbers) in enumerate(zip(folders, (range(3), range(3, SHARDS)), strict=True)):
        folder.mkdir()
        for index, at in enumerate(numbers):
            some = structs.take(episodes, slice(4 * at, 4 * at + 4))
            shards.write_shard(folder, index, some, kind="push", config={"seed": seed}, faults={"late": at})
        manifest.update_manifest(folder)
    return folders


@pytest.fixture
def whole(sets: tuple[pathlib.Path, pathlib.Path], tmp_path: pathlib.Path) -> dict[str, bytes]:
    """Return the files of both joined in a folder."""
    assert merge(*sets, "--out", tmp_path / "whole") == 0
    return _bytes(tmp_path / "whole")


def test_they_are_the_same_and_a_second_merge_replaces_no_shard(
    sets: tuple[pathlib.Path, pathlib.Path],
    whole: dict[str, bytes],
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    there, url = tmp_path / "there", f"file://{tmp_path}/there"
    assert merge(f"file://{sets[0]}", sets[1], "--out", url) == 0
    assert _bytes(there) == whole and len(shards.shard_files(there)) == SHARDS
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == f"{url}: 20 push episodes in 5 shards: 12 from file://{sets[0]}, 8 from {sets[1]}"
    (there / "manifest.json").unlink()
    shards.shard_path(there, 1).unlink()
    kept = shards.shard_path(there, 0).stat().st_ino
    assert merge(*sets, "--out", url) == 0
    assert _bytes(there) == whole and shards.shard_path(there, 0).stat().st_ino == kept


def test_parts_of_one_data_set_keep_their_numbers_and_what_is_missing_is_said(
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    disks = (tmp_path / "disk1", tmp_path / "disk2")
    for index, folder in enumerate(disks):
        shutil.copytree(data["push"], folder)
        shards.shard_path(folder, 1 - index).unlink()
        manifest.update_manifest(folder)
        files.write_json(folder / "asked.json", {"command": ["push"], "of": 1})
        files.write_json(folder / "config.json", files.read_json(folder / "config.json") | {"episodes": 48})
    url = f"file://{tmp_path}/there"
    assert merge(*reversed(disks), "--out", url) == 0
    wanted = {name: content for name, content in _bytes(data["push"]).items() if name.startswith("shard")}
    assert {name: content for name, content in _bytes(tmp_path / "there").items() if name in wanted} == wanted
    assert list(manifest.listed(tmp_path / "there")) == sorted(wanted)
    said = f"warning: {url}: 24 of 48 episodes, shards 1, 2 missing: run `dipn-datagen push --out {url}`"
    assert said in capsys.readouterr().err.splitlines()


def test_what_is_there_of_somebody_else_stays_and_is_one_line(
    sets: tuple[pathlib.Path, pathlib.Path],
    data: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there, url = tmp_path / "there", f"file://{tmp_path}/there"

    def refused(says: str, *words: object) -> None:
        before = _bytes(there)
        capsys.readouterr()
        assert merge(*words, "--out", url) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error, error
        assert _bytes(there) == before

    same = shutil.copytree(sets[0], tmp_path / "same")
    refused("are equal: the same scenes twice", *sets, same)
    refused("is named twice", sets[0], f"file://{sets[0]}")
    refused("is named twice", sets[0], there)
    assert not there.exists(), "nothing is written"
    shutil.copytree(data["push"], there)
    another = f"error: --out {url}: holds another data set; give another URL\n"
    refused(another, *sets)
    (there / "config.json").unlink()
    refused(another, *sets)
    shutil.rmtree(there)
    assert merge(*sets, "--out", url) == 0
    path = shards.shard_path(there, 1)
    path.write_bytes(path.read_bytes()[:-1])
    refused(f"error: --out {url}: its shard-00001.parquet is not {sets[0]}/shard-00001.parquet; give another", *sets)
    shutil.rmtree(there)
    create = Bucket.create

    def late(self: Bucket, name: str, content: bytes) -> bool:
        """Another one creates its own at the same moment."""
        create(self, name, b"{}" if name == "config.json" else b"theirs")
        return create(self, name, content)

    monkeypatch.setattr(Bucket, "create", late)
    assert merge(*sets, "--out", url) == 2
    assert capsys.readouterr().err == another and _bytes(there) == {"config.json": b"{}"}
    monkeypatch.setattr(Bucket, "create", lambda *given: (late if "shard" in given[1] else create)(*given))
    shutil.rmtree(there)
    assert merge(*sets, "--out", url) == 2
    assert f"error: --out {url}: its shard-0000" in capsys.readouterr().err and "manifest.json" not in _bytes(there)
    assert {content for name, content in _bytes(there).items() if "shard" in name} == {b"theirs"}


@pytest.mark.slow
def test_a_merge_that_is_killed_goes_on_and_racing_ones_create_each_shard_once(
    sets: tuple[pathlib.Path, pathlib.Path], whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3_server

    with s3_server.running(monkeypatch):
        for path in sets[1].iterdir():
            if not path.name.startswith("."):
                s3_server.client().put_object(Bucket="bucket", Key=f"two/{path.name}", Body=path.read_bytes())
        words = ["merge", str(sets[0]), "s3://bucket/two", "--out", "s3://bucket/joined"]
        s3_server.kill_at_third_shard(words)
        left = s3_server.contents("joined")
        assert len(left) == 3 and left.items() <= whole.items() and "manifest.json" not in left
        assert merge(*sets[::-1], "--out", "s3://bucket/joined") == 2, "another data set: other numbers"
        assert s3_server.contents("joined") == left
        command = [sys.executable, "-m", "dipn_jax.datagen.cli", *words]
        both = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(2)]
        assert [(each.communicate()[1], each.returncode)[1] for each in both] == [0, 0]
        assert s3_server.contents("joined") == whole
        written = s3_server.versions("joined")
        assert {written[name] for name in written if name.startswith(("shard", "config"))} == {1}
        assert console.run("test", cli.COMMANDS, ["verify", "s3://bucket/joined"]) == 0
        two = s3_server.contents("two")
        assert two == {name: content for name, content in _bytes(sets[1]).items()}, "the source is untouched"
