import json
import pathlib

import jax
import numpy as np
import pytest
from flax import nnx

from dipn_jax import checkpoint
from dipn_jax.errors import UserError
from dipn_jax.networks.grasp import GraspConfig

CONFIG = GraspConfig(width=8)


def _save(run: pathlib.Path, step: int, seed: int = 0) -> nnx.Module:
    model = checkpoint.build("grasp", CONFIG, seed=seed)
    checkpoint.save(run, step, {"model": nnx.state(model)}, network="grasp", config=CONFIG, extra={})
    return model


def _leaves(model: nnx.Module) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(nnx.state(model))]


def test_what_is_loaded_is_what_was_saved(tmp_path: pathlib.Path) -> None:
    model = _save(tmp_path, 10, seed=3)
    loaded = checkpoint.load_network(tmp_path, network="grasp")
    assert loaded.config == CONFIG
    for a, b in zip(_leaves(model), _leaves(loaded), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("damage", ["flip", "empty", "no meta"])
def test_a_damaged_step_is_passed_over(tmp_path: pathlib.Path, damage: str) -> None:
    good = _save(tmp_path, 1, seed=1)
    _save(tmp_path, 2, seed=2)
    step = tmp_path / "checkpoints" / "00000002"
    if damage == "flip":
        largest = max((p for p in step.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
        content = bytearray(largest.read_bytes())
        content[len(content) // 2] ^= 1
        largest.write_bytes(content)
    elif damage == "empty":
        (tmp_path / "checkpoints" / "00000003").mkdir()
        (step / "meta.json").write_text("{}")
    else:
        (step / "meta.json").unlink()
    loaded = checkpoint.load_network(tmp_path, network="grasp")
    np.testing.assert_array_equal(_leaves(loaded)[0], _leaves(good)[0])


def test_only_the_newest_steps_are_kept(tmp_path: pathlib.Path) -> None:
    for step in (1, 2, 3):
        _save(tmp_path, step)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["00000002", "00000003"]
    (tmp_path / "checkpoints" / "00000003" / "meta.json").write_text("[]")
    _save(tmp_path, 4)
    assert checkpoint.newest(tmp_path)[1]["step"] == 4  # type: ignore[index]
    assert (tmp_path / "checkpoints" / "00000002").exists(), "the damaged step does not push out the good one"


def test_what_cannot_be_used_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        checkpoint.load_network(tmp_path / "nowhere", network="grasp")
    with pytest.raises(UserError, match="no whole step"):
        checkpoint.load_network(tmp_path, network="grasp")
    _save(tmp_path, 1)
    with pytest.raises(UserError, match="holds a grasp network, want dipn"):
        checkpoint.load_network(tmp_path, network="dipn")


def test_another_architecture_is_named(tmp_path: pathlib.Path) -> None:
    _save(tmp_path, 1)
    path = tmp_path / "checkpoints" / "00000001" / "meta.json"
    meta = json.loads(path.read_text())
    meta["network_config"]["width"] = 16
    path.write_text(json.dumps(meta))
    with pytest.raises(UserError, match="another architecture"):
        checkpoint.load_network(tmp_path, network="grasp")
    meta["network_config"]["depth"] = 3
    path.write_text(json.dumps(meta))
    with pytest.raises(UserError, match="config does not fit"):
        checkpoint.load_network(tmp_path, network="grasp")
