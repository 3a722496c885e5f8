"""Batches are made in order, one ahead, and their errors come at their steps."""

import threading

import pytest
from dipn_jax.train.prefetch import Prefetcher


def test_batches_come_in_order_and_the_next_is_made_meanwhile() -> None:
    made: list[int] = []
    begun = {step: threading.Event() for step in range(3, 6)}

    def make(step: int) -> int:
        made.append(step)
        begun[step].set()
        return 10 * step

    with Prefetcher(make, 3, 6) as ahead:
        for step in range(3, 6):
            assert ahead.take() == 10 * step
            assert step == 5 or begun[step + 1].wait(10), "without being asked for"
    assert made == [3, 4, 5]


def test_an_error_is_raised_at_the_step_of_its_batch_and_the_thread_ends() -> None:
    def make(step: int) -> int:
        if step == 1:
            raise ValueError("no room")
        return step

    with pytest.raises(ValueError, match="no room"), Prefetcher(make, 0, 3) as ahead:
        assert ahead.take() == 0
        ahead.take()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("batches")]
