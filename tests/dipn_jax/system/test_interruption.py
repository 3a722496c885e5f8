"""Every signal by which a job manager or a terminal ends work is an interruption."""

import os
import signal
from collections.abc import Iterator

import pytest

from dipn_jax.commands import console
from dipn_jax.system.interruption import Interruption

ALL = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1]


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """Put the handlers of this process back."""
    old = {number: signal.getsignal(number) for number in ALL}
    yield
    for number, handler in old.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ALL)
def test_a_signal_lets_the_step_at_hand_end_and_a_command_ends_as_interrupted(number: signal.Signals) -> None:
    done = []

    def work() -> None:
        with Interruption() as interruption:
            os.kill(os.getpid(), number)
            done.append("step")
            assert interruption.requested
            os.kill(os.getpid(), number)  # the second one does not wait
            done.append("never")

    assert console.exit_code(work) == 130
    assert done == ["step"]


def test_a_hang_up_that_nohup_ignores_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)

    def work() -> None:
        with Interruption() as interruption:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interruption.requested
        os.kill(os.getpid(), signal.SIGHUP)

    assert console.exit_code(work) == 0
