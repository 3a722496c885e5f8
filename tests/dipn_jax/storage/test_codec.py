"""Columns are read within half a quantum of what was written, whatever type they are stored as."""

import jax
import numpy as np
import pytest

from dipn_jax import structs
from dipn_jax.storage import codec


def _columns(rng: np.random.Generator, *, push: bool) -> codec.Columns:
    poses = rng.normal(size=(5, 11, 3, 7) if push else (5, 3, 7)).astype(np.float32)
    return {
        "scene.shape": rng.integers(-1, 5, (5, 3), np.int32),
        "scene.size": rng.uniform(0.02, 0.1, (5, 3, 3)).astype(np.float32),
        "poses": poses,
        "after": (poses[:, -1] if push else poses) + np.float32(0.1),
        "success": rng.random(5) < 0.5,
    }


@pytest.mark.parametrize("push", [True, False])
def test_a_round_trip_loses_half_a_quantum_at_most(rng: np.random.Generator, push: bool) -> None:
    columns = _columns(rng, push=push)
    stored, specs = codec.encode(columns)
    again = codec.decode(stored, specs)
    for name, value in columns.items():
        assert again[name].dtype == value.dtype and again[name].shape == value.shape
        np.testing.assert_allclose(again[name], value, atol=codec.QUANTA.get(name, 0) * 0.5 + 5e-7, rtol=0)
        assert (stored[name].dtype == np.int32) == (name in codec.QUANTA or name == "scene.shape")
    twice, _ = codec.encode(again)
    jax.tree.map(np.testing.assert_array_equal, twice, stored)


def test_objects_that_do_not_move_any_more_are_stored_as_zeros(rng: np.random.Generator) -> None:
    columns = _columns(rng, push=True)
    columns["poses"] = np.repeat(columns["poses"][:, :1], 11, 1)
    columns["after"] = columns["poses"][:, -1]
    stored, _ = codec.encode(columns)
    assert not stored["after"].any()
    np.testing.assert_array_equal(stored["poses"], stored["poses"][:, :1].repeat(11, 1))


def test_a_palette_colour_is_exact() -> None:
    color = (np.arange(256, dtype=np.float32) / np.float32(255)).reshape(1, -1, 1)
    stored, specs = codec.encode({"scene.color": color})
    np.testing.assert_allclose(codec.decode(stored, specs)["scene.color"], color, atol=1e-7)


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="too large"):
        codec.encode({"scene.mass": np.full((1, 1), 3000.0, np.float32)})


def test_values_that_are_not_finite_are_refused(rng: np.random.Generator) -> None:
    columns = _columns(rng, push=True)
    columns["poses"][0, 0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="poses: not finite"):
        codec.encode(columns)


def test_what_is_rounded_is_stored_and_read_without_a_loss(rng: np.random.Generator) -> None:
    """Fields of a struct by itself have the quanta that they have within an episode."""
    angle = rng.uniform(0, 6, 5).astype(np.float32)
    push = structs.Push(rng.uniform(-0.2, 0.2, (5, 2)).astype(np.float32), angle, np.full(5, 0.1, np.float32))
    rounded = codec.rounded(push, prefix="push.")
    assert (rounded.angle != angle).any() and np.abs(rounded.angle - angle).max() < 1e-6
    stored = {f"push.{name}": value for name, value in codec.columns(rounded).items()}
    again = codec.decode(*codec.encode(stored))
    for name, value in stored.items():
        np.testing.assert_array_equal(again[name], value)
    np.testing.assert_array_equal(codec.rounded(push).angle, angle, "without the prefix it is an unknown column")
