"""What a Ray cluster of two nodes makes is what one machine makes, byte for byte."""

import importlib.util
import pathlib
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from dipn_jax.datagen import cli as datagen
from dipn_jax.eval import cli as evaluation
from dipn_jax.train import cli as train
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install '.[ray]'"),
]
DATA_SETS = {
    "push": ("--objects", "1", "--episodes", "3", "--shard-size", "1", "--actions", "1"),
    "grasp": ("--objects", "1", "--episodes", "3", "--shard-size", "1", "--actions", "1"),
}
"""Small data sets of three shards."""
EVALUATIONS = {
    "prediction": ("--push-net", "dipn", "--scenes", "65", "--objects", "1", "--no-physics"),  # two groups of pushes
    "grasp": ("--grasp-net", "grasp", "--scenes", "2", "--objects", "1", "--others", "1", "--aids"),
    "sweep": ("--push-net", "dipn", "--grasp-net", "grasp", "--cases", "random", "--objects", "1", "--instances", "2",
              "--distances", "0.05:0.05:0.01", "--candidates", "2", "--pushes", "2", "--aids"),
}  # fmt: skip
"""Small evaluations, and the networks that they need."""
ON_CLUSTER = ("--launcher", "ray")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Return a cluster of two nodes, whose workers know the bucket of an S3 server."""
    import ray_cluster
    import s3_server

    with pytest.MonkeyPatch.context() as patch, s3_server.running(patch), ray_cluster.of_nodes(2) as started:
        yield started


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return runs of small networks with random weights."""
    folder = tmp_path_factory.mktemp("networks")
    for name, config in (("dipn", DipnConfig(width=8)), ("grasp", GraspConfig(width=8, coarse=8, blocks=1))):
        state = {"model": nnx.state(checkpoint.build(name, config))}
        checkpoint.save(folder / name, 1, state, network=name, config=config, extra={})
    return {name: str(folder / name) for name in ("dipn", "grasp")}


def _run(commands: dict[str, Any], *words: str) -> None:
    assert console.run("test", commands, words) == 0, words


def _bytes(folder: pathlib.Path) -> dict[str, bytes]:
    """Return the files of a data set or an evaluation, without what says how it was made, and pictures."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("[!.]*") if path.is_file()}
    other = ("asked.json", "settings.json", ".png")
    kept = [name for name in files if not name.startswith("parts/") and not name.endswith(other)]
    return {name: files[name].read_bytes() for name in kept}


@pytest.mark.parametrize("kind", DATA_SETS)
def test_it_makes_the_data_set_of_one_machine(kind: str, cluster: Any, tmp_path: pathlib.Path) -> None:
    words = (kind, *DATA_SETS[kind], "--engine", "native")
    _run(datagen.COMMANDS, *words, "--out", str(tmp_path / "alone"))
    _run(datagen.COMMANDS, *words, "--out", str(tmp_path / "out"), *ON_CLUSTER)
    assert _bytes(tmp_path / "out") == _bytes(tmp_path / "alone")
    assert len(list((tmp_path / "out").glob("*.parquet"))) == 3


def test_it_makes_the_data_set_of_one_machine_in_a_bucket(cluster: Any, tmp_path: pathlib.Path) -> None:
    import s3_server

    words = ("push", *DATA_SETS["push"], "--engine", "native")
    _run(datagen.COMMANDS, *words, "--out", str(tmp_path))
    _run(datagen.COMMANDS, *words, "--out", "s3://bucket/push", *ON_CLUSTER)
    there = {name: content for name, content in s3_server.contents("push").items() if name != "asked.json"}
    assert there == _bytes(tmp_path)
    assert {count for name, count in s3_server.versions("push").items() if name.startswith("shard")} == {1}


@pytest.mark.parametrize("kind", EVALUATIONS)
def test_it_makes_the_evaluation_of_one_machine(
    kind: str, cluster: Any, networks: dict[str, str], tmp_path: pathlib.Path
) -> None:
    words = (kind, *(networks.get(word, word) for word in EVALUATIONS[kind]), "--engine", "native")
    _run(evaluation.COMMANDS, *words, "--out", str(tmp_path / "alone"))
    _run(evaluation.COMMANDS, *words, "--out", str(tmp_path / "out"), *ON_CLUSTER, "--of", "2")
    assert _bytes(tmp_path / "out") == _bytes(tmp_path / "alone")
    assert "metrics.json" in _bytes(tmp_path / "out") and len(list((tmp_path / "out" / "parts").iterdir())) == 2


def test_a_sweep_whose_workers_are_killed_trains_the_networks_of_one_machine(
    cluster: Any, data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    """They are killed when the first training has written a checkpoint, and continue from there."""
    import ray_cluster

    killed: list[int] = []
    command = ("grasp", "--data", str(data["grasp"]), "--steps", "6", "--batch", "2", "--save-every", "1")
    out = tmp_path / "out"

    def kill() -> None:
        until = time.monotonic() + 300
        while not killed and time.monotonic() < until:
            time.sleep(0.05)
            if any(name.name.isdecimal() for name in out.glob("*/checkpoints/*")):
                killed.append(ray_cluster.kill_workers(cluster))

    killer = threading.Thread(target=kill)
    killer.start()
    _run(train.COMMANDS, "sweep", "--seeds", "0", "1", "--out", str(out), *ON_CLUSTER, "--", *command)
    killer.join()
    assert killed and killed[0] >= 1
    for seed in ("0", "1"):
        alone = tmp_path / f"alone-{seed}"
        _run(train.COMMANDS, *command, "--seed", seed, "--out", str(alone))
        found = [
            checkpoint.digest(checkpoint.load_network(run, network="grasp")) for run in (out / f"seed-{seed}", alone)
        ]
        assert found[0] == found[1]
