"""Every example runs and shows what it says: its variables are compared with known values."""

import pathlib
import runpy
from typing import Any

import numpy as np
import pytest
from flax import nnx

import dipn_jax

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


def run(name: str) -> dict[str, Any]:
    """Run an example and return its variables."""
    (path,) = EXAMPLES.glob(f"{name}_*.py")
    return runpy.run_path(str(path))


def test_there_are_seven_of_at_most_forty_lines() -> None:
    paths = sorted(EXAMPLES.glob("*.py"))
    assert [path.name[:3] for path in paths] == ["01_", "02_", "03_", "04_", "05_", "06_", "07_"]
    assert all(len(path.read_text().splitlines()) <= 40 for path in paths)


def test_01_grasps_the_block_that_stands_apart(capsys: pytest.CaptureFixture[str]) -> None:
    found = run("01")
    _, row, col = found["decision"].grasp_pixel
    assert capsys.readouterr().out.startswith("grasp ")
    assert not found["decision"].is_push and found["observation"].label[row, col] == 0


def test_02_the_imagined_image_is_nearer_than_no_motion() -> None:
    found = run("02")
    assert found["imagined"] > 0.8 > found["nothing_moves"]


def test_03_reads_what_it_made() -> None:
    found = run("03")
    assert found["episodes"].poses.shape == (8, 11, 3, 7) and found["size"] < 8 * 2000
    assert 0.01 < found["moved"].max() < 0.2, "a push of 10 cm moves something"


@pytest.mark.slow
def test_04_the_loss_falls() -> None:
    found = run("04")
    assert [point["step"] for point in found["curve"]] == [10, 20, 30]
    assert found["curve"][-1]["loss"] < 0.7 * found["curve"][0]["loss"]
    assert found["motion"].shape == (1, 3, 3)


def test_05_longer_pushes_move_objects_further() -> None:
    moved = run("05")["moved"]
    assert moved.shape == (12, 6) and moved[0].max() < 0.005, "the gripper has not arrived after 1 cm"
    assert (np.diff(moved[2:].max(1)) > 0).all() and 0.05 < moved[-1].max() < 0.12


@pytest.mark.slow
def test_06_clears_the_table() -> None:
    found = run("06")
    assert (found["scene"].shape < 0).all() and found["actions"].count("grasp") == 4


def test_07_scores_as_the_network_does_in_jax() -> None:
    found = run("07")
    assert "jax" not in (EXAMPLES / "07_weights_without_jax.py").read_text().split("with safe_open")[1]
    network = dipn_jax.load_network(network="grasp")
    np.testing.assert_allclose(found["scores"], nnx.sigmoid(network(found["image"][None]))[0], atol=1e-4)
    row, col = np.unravel_index(found["scores"].argmax(), found["scores"].shape)
    assert 140 <= row < 180 and 180 <= col < 195, "it grasps the block"
