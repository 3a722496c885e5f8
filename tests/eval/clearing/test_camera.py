"""What a policy sees: masks found in the image, noise, holes."""

import functools
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.eval.clearing import camera
from dipn_jax.eval.clearing.camera import Camera

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.sight import render, segment


@pytest.fixture(scope="module")
def two(settled: Any) -> Any:
    """Return keys, scenes and poses of two tables."""
    return jax.random.split(jax.random.key(3), 2), structs.take(settled.scene, slice(0, 2)), settled.poses[:2]


def test_masks_are_cut_out_of_the_image_and_not_the_simulators(two: Any) -> None:
    found, true = Camera().look(*two), Camera(masks="true").look(*two)
    np.testing.assert_array_equal(found.height, true.height)
    for i in range(2):
        want = segment.segment(true.height[i], true.color[i], slots=true.slots)
        np.testing.assert_array_equal(found.label[i], want)
    np.testing.assert_array_equal(true.label, render.observe(*two[1:]).label)
    assert (found.label != true.label).any(), "found masks are numbered by size, not as objects"
    assert ((found.label >= 0) == (true.label >= 0)).mean() > 0.99


def test_noise_has_the_size_asked_for_and_comes_from_the_key(two: Any) -> None:
    keys, scene, poses = two
    clean = Camera(masks="true").look(*two)
    look = functools.partial(Camera(masks="true", height_noise=0.002, image_noise=0.03).look, scene=scene, poses=poses)
    noisy = look(keys)
    assert np.std(noisy.height - clean.height) == pytest.approx(0.002, rel=0.02)
    middle = (clean.color > 0.2) & (clean.color < 0.8)  # nothing is cut off there
    assert np.std((noisy.color - clean.color)[middle]) == pytest.approx(0.03, rel=0.02)
    np.testing.assert_array_equal(look(keys).height, noisy.height)
    assert (look(keys[::-1]).height != noisy.height).any()
    assert np.corrcoef(*(noisy.height - clean.height).reshape(2, -1))[0, 1] < 0.02, "both tables have the same noise"


def test_holes_cover_their_share_and_take_the_nearest_height(rng: np.random.Generator) -> None:
    for share in (0.05, 0.3):
        assert camera.spots(rng, (224, 224), share).mean() == pytest.approx(share, rel=0.1)
    assert not camera.spots(rng, (224, 224), 0.0).any()
    height = np.tile(np.arange(8.0), (8, 1))
    holes = np.zeros((8, 8), bool)
    holes[3, 2] = holes[5, 6:] = True
    filled = camera.filled(height, holes)
    assert filled[3, 2] in (1, 2, 3) and filled[5, 7] in (5, 7)
    np.testing.assert_array_equal(filled[~holes], height[~holes])


def test_an_amount_of_noise_that_makes_no_sense_is_refused() -> None:
    for name in ("height_noise", "holes", "image_noise"):
        with pytest.raises(UserError, match=f"--{name.replace('_', '-')} -1"):
            Camera(**{name: -1.0})
    with pytest.raises(UserError, match="--height-noise 2: want 0 to"):
        Camera(height_noise=2.0)
