"""The order of examples: each once an epoch, or by the shares that are asked for."""

import dataclasses

import numpy as np
import pytest
from dipn_jax.train import example_order
from dipn_jax.train.configs import TrainConfig
from dipn_jax.train.split import within

from dipn_jax.errors import UserError

CONFIG = TrainConfig(batch=4)


def _seen(parts: tuple[int, ...], config: TrainConfig, steps: int) -> np.ndarray:
    batches = example_order.batches(parts, config)
    return np.concatenate([np.asarray(batches[step]) for step in range(steps)])


def test_every_example_is_seen_once_an_epoch_whatever_the_data_sets() -> None:
    seen = _seen((10, 6), CONFIG, 8)
    for epoch in np.split(seen, 2):
        np.testing.assert_array_equal(np.sort(epoch), np.arange(16))
    assert (seen[:16] != seen[16:]).any()
    np.testing.assert_array_equal(seen, _seen((16,), CONFIG, 8))
    assert (seen != _seen((10, 6), dataclasses.replace(CONFIG, seed=1), 8)).any()


def test_a_mix_takes_its_share_from_each_data_set_and_all_of_both() -> None:
    mixed = dataclasses.replace(CONFIG, mix=(1.0, 3.0))
    seen = _seen((10, 6), mixed, 40)
    assert all((some >= 10).sum() == 3 for some in np.split(seen, 40))
    np.testing.assert_array_equal(np.bincount(seen[seen < 10]), np.full(10, 4))
    np.testing.assert_array_equal(np.bincount(seen[seen >= 10])[10:], np.full(6, 20))
    np.testing.assert_array_equal(example_order.batches((10, 6), mixed)[7], seen[28:32])


def test_the_first_examples_are_of_the_first_data_sets() -> None:
    assert [within((10, 6, 4), count) for count in (20, 17, 3)] == [(10, 6, 4), (10, 6, 1), (3, 0, 0)]


@pytest.mark.parametrize(
    ("parts", "mix", "says"),
    [
        ((10, 6), (1.0,), r"--mix 1: want a number for each folder of --data, 2"),
        ((10,), (1.0, 2.5), r"--mix 1 2.5: want a number for each folder of --data, 1"),
        ((10, 6), (1.0, 0.0), r"--mix 0\.0: want a number above 0"),
        ((10, 0), (1.0, 1.0), r"--mix 1 1: --limit leaves nothing of data set 2"),
    ],
)
def test_a_mix_that_makes_no_sense_is_refused(parts: tuple[int, ...], mix: tuple[float, ...], says: str) -> None:
    with pytest.raises(UserError, match=says):
        example_order.batches(parts, dataclasses.replace(CONFIG, mix=mix))


@pytest.mark.parametrize(
    ("size", "said"),
    [
        (199_000, "each of 199,000 is seen 0.24 times on average; only more --steps would see all"),
        (48_000, "each of 48,000 is seen 1 times on average"),
        (20, "each of 20 is seen 2,400 times on average"),
    ],
)
def test_a_training_says_how_often_it_sees_its_examples(size: int, said: str) -> None:
    assert example_order.passes(size, TrainConfig(steps=1500)) == f"1500 steps of 32 examples; {said}"
