"""Data sets in object storage are those of a folder, and every command reads them by their URL."""

import collections
import json
import os
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import obstore
import pytest
from dipn_jax.datagen import cli
from dipn_jax.train import cli as train

from dipn_jax.commands import console, launch
from dipn_jax.commands.launch import Launch
from dipn_jax.storage import checkpoint, places
from dipn_jax.storage.objects import Bucket

WORDS = ("images", "--objects", "1", "--episodes", "6", "--shard-size", "1", "--engine", "native")


def _bytes(folder: pathlib.Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*")}


@pytest.fixture(autouse=True)
def cache(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let copies be made below a folder of the test."""
    compiled = os.environ.get("JAX_COMPILATION_CACHE_DIR") or os.path.expanduser("~/.cache/dipn-jax/xla")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", compiled)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Return the data set as one machine makes it in a folder, by the command."""
    out = tmp_path_factory.mktemp("alone")
    assert console.run("test", cli.COMMANDS, [*WORDS, "--out", str(out)]) == 0
    return out


def test_it_is_made_continued_and_extended_as_in_a_folder(
    alone: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "there"
    words = [*WORDS, "--out", f"file://{there}"]
    shorter = ["2" if word == "6" else word for word in words]
    assert console.run("test", cli.COMMANDS, shorter) == 0 and len(_bytes(there)) == 5
    kept = (there / "shard-00000.parquet").stat().st_mtime_ns
    assert console.run("test", cli.COMMANDS, [*words, "--shard", "0", "--of", "2"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        f"file://{there}: 4 of 6 shards are there; the worker that ends last lists them"
    )
    assert console.run("test", cli.COMMANDS, ["verify", f"file://{there}"]) == 2
    (said,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("error"))
    assert said.startswith(f"error: file://{there}: 4 of 6 episodes, shards 3, 5 missing: run `dipn-datagen images")
    assert said.endswith(f"--out file://{there} --shard 1 --of 2`")
    assert console.run("test", cli.COMMANDS, words) == 0
    assert _bytes(there) == _bytes(alone)
    assert (there / "shard-00000.parquet").stat().st_mtime_ns == kept
    capsys.readouterr()
    assert console.run("test", cli.COMMANDS, [*words, "--seed", "1"]) == 2
    assert capsys.readouterr().err == (
        f"error: file://{there}: begun with seed=0, asked for seed=1; give another --out, or the same options and data "
        "to continue\n"
    )


def test_tasks_make_it(alone: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tasks that are called here, each twice, as one is whose worker is lost when it has written."""

    def run(function: Any, tasks: Any, *, launch: Launch) -> Iterator[tuple[int, Any]]:
        for number, task in enumerate(tasks):
            assert function(*task) == function(*task)
            yield number, function(*task)

    create, tried = Bucket.create, list[str]()
    monkeypatch.setattr(launch, "run", run)
    monkeypatch.setattr(Bucket, "create", lambda self, name, data: (tried.append(name), create(self, name, data))[1])
    assert console.run("test", cli.COMMANDS, [*WORDS, "--out", f"file://{tmp_path}/there", "--launcher", "ray"]) == 0
    assert _bytes(tmp_path / "there") == _bytes(alone)
    assert sorted(tried) == ["config.json", *(f"shard-{index:05d}.parquet" for index in range(6))], "made once"


def test_what_a_job_asks_of_a_bucket_grows_by_its_shards_alone(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each task looks for its own shard; the bucket is listed, and its manifest read, a fixed number of times."""

    def requests(episodes: int) -> collections.Counter[str]:
        asked: collections.Counter[str] = collections.Counter()

        def counting(name: str, request: Callable[..., Any]) -> Callable[..., Any]:
            def counted(store: Any, *args: Any, **options: Any) -> Any:
                asked[f"{name} shard" if str(args[:1]).startswith("('shard") else " ".join([name, *args[:1]])] += 1
                return request(store, *args, **options)

            return counted

        words = [str(episodes) if word == "6" else word for word in WORDS]
        with monkeypatch.context() as patch:
            patch.setattr(launch, "run", lambda make, tasks, *, launch: enumerate(make(*task) for task in tasks))
            for name in ("list", "get", "head", "put"):
                patch.setattr(obstore, name, counting(name, getattr(obstore, name)))
            out = f"file://{tmp_path}/{episodes}"
            assert console.run("test", cli.COMMANDS, [*words, "--out", out, "--launcher", "ray"]) == 0
        return asked

    few, many = requests(places.MAX_HEAD_REQUESTS + 1), requests(places.MAX_HEAD_REQUESTS + 4)
    assert many - few == {"get config.json": 3, "head shard": 3, "put shard": 3}
    assert few["list"] == 3 and few["get manifest.json"] == 1


def test_the_commands_read_it(
    data: dict[str, pathlib.Path], alone: pathlib.Path, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    urls = {kind: f"file://{folder}" for kind, folder in data.items()}
    for half, names in (("one", "shard-0000[012]*"), ("other", "shard-0000[345]*")):
        (tmp_path / half).mkdir()
        for path in (alone / "config.json", *alone.glob(names)):
            shutil.copy(path, tmp_path / half)
    halves = [f"file://{tmp_path}/{half}" for half in ("one", "other")]
    for words in (
        ["verify", urls["push"]],
        ["replay", urls["grasp"], "0"],
        ["export", urls["push"], "--out", str(tmp_path / "exported")],
        ["merge", *halves, "--out", str(tmp_path / "merged")],
        ["info", urls["push"], "--html", str(tmp_path / "page.html"), "--sample", "1"],
    ):
        assert console.run("test", cli.COMMANDS, words) == 0, words
    merged = {name: content for name, content in _bytes(alone).items() if name != "asked.json"}
    assert {name: content for name, content in _bytes(tmp_path / "merged").items()} == merged
    assert json.loads("{" + capfd.readouterr().out.partition("\n{")[2])["episodes"] == 24
    for path in (tmp_path / "page.html", tmp_path / "exported" / "README.md"):
        assert urls["push"] in path.read_text() and "cache" not in path.read_text()


def test_a_training_reads_it(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    (copy, same) = train._local((pathlib.Path(f"file://{data['push']}"), data["push"]))
    assert same == data["push"] and copy != same and _bytes(copy) == _bytes(same)


@pytest.mark.slow
def test_a_training_on_a_bucket_is_that_on_a_folder(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3_server

    with s3_server.running(monkeypatch):
        for path in data["grasp"].iterdir():
            s3_server.client().put_object(Bucket="bucket", Key=f"grasp/{path.name}", Body=path.read_bytes())
        digests = []
        for name, place in (("folder", str(data["grasp"])), ("bucket", "s3://bucket/grasp")):
            out = tmp_path / name
            words = ["grasp", "--data", place, "--out", str(out), "--steps", "2", "--batch", "2"]
            assert console.run("test", train.COMMANDS, words) == 0
            digests.append(checkpoint.digest(checkpoint.load_network(out, network="grasp")))
    assert digests[0] == digests[1]


def test_what_cannot_be_there_is_refused_in_one_line(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = f"file://{tmp_path}/gone"
    for words, said in (
        (["merge", gone], f"merge {gone}: shards need not be listed there; dipn-datagen verify {gone} checks them"),
        (["export", "data", "--out", "gs://b/x"], "gs://b/x: a URL, which this option does not take; give a path"),
        (["info", gone], f"data set {gone}: no such folder; give one that dipn-datagen wrote"),
    ):
        assert console.run("test", cli.COMMANDS, words) == 2
        assert capsys.readouterr().err == f"error: {said}\n"


@pytest.mark.slow
def test_racing_writers_make_each_shard_once_and_a_killed_ones_work_goes_on(
    alone: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3_server

    with s3_server.running(monkeypatch):
        words = [*WORDS, "--out", "s3://bucket/data"]
        s3_server.kill_at_third_shard(words)
        kept = {name for name in s3_server.contents("data") if name.startswith("shard")}
        assert len(kept) == 2 and "manifest.json" not in s3_server.contents("data")
        command = [sys.executable, "-m", "dipn_jax.datagen.cli", *words]
        writers = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(3)]
        assert [(writer.communicate()[1], writer.returncode)[1] for writer in writers] == [0, 0, 0]
        assert s3_server.contents("data") == _bytes(alone)
        written = s3_server.versions("data")
        assert {name: count for name, count in written.items() if name.startswith("shard")} == dict.fromkeys(
            (f"shard-{index:05d}.parquet" for index in range(6)), 1
        )
        assert Bucket("s3://bucket/data").list().keys() == _bytes(alone).keys()
        assert console.run("test", cli.COMMANDS, ["verify", "s3://bucket/data"]) == 0
        assert console.run("test", cli.COMMANDS, [*words, "--seed", "1"]) == 2
