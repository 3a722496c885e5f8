"""Every signal by which a job manager or a terminal ends work is an interruption."""

import gc
import os
import signal
import time
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
def test_a_signal_lets_the_current_step_end_and_interrupts_the_command(number: signal.Signals) -> None:
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


@pytest.mark.parametrize("number", ALL)
def test_a_signal_within_a_callback_is_not_lost(number: signal.Signals, capfd: pytest.CaptureFixture[str]) -> None:
    """Python prints what a callback raises, and continues."""

    def callback(phase: str, _: object) -> None:
        if phase == "start" and callback in gc.callbacks:
            gc.callbacks.remove(callback)
            os.kill(os.getpid(), number)

    def work() -> None:
        gc.callbacks.append(callback)
        gc.collect()
        time.sleep(5)

    assert console.exit_code(work) == 130
    assert capfd.readouterr().err == f"{console.INTERRUPTED}\n"


def test_what_a_library_makes_of_an_interruption_is_one(capfd: pytest.CaptureFixture[str]) -> None:
    def work() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:
            raise RecursionError("in an import") from None

    assert console.exit_code(work) == 130
    assert capfd.readouterr().err == f"{console.INTERRUPTED}\n"
