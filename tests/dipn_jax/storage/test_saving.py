"""Checkpoints in the background: nothing that training does meanwhile gets into them, and no error is lost."""

import asyncio
import errno
import gc
import logging
import pathlib
import sys
import threading
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint, quiet
from dipn_jax.storage.saving import Saver

PATIENCE = 60.0
"""Seconds that a test waits for a thread at most."""


class Slow:
    """Stands in for `checkpoint.save`: writes nothing, and continues only when the test allows it."""

    def __init__(self) -> None:
        self.begun, self.allowed = threading.Semaphore(0), threading.Semaphore(0)
        self.saved: list[tuple[int, Any]] = []

    def __call__(self, run: pathlib.Path, step: int, parts: dict[str, Any], **_: Any) -> None:
        self.begun.release()
        assert self.allowed.acquire(timeout=PATIENCE)
        self.saved.append((step, parts["model"]))
        if step == 13:
            raise UserError("step 13 cannot be saved")


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Slow:
    found = Slow()
    monkeypatch.setattr(checkpoint, "save", found)
    return found


def _saver(run: pathlib.Path) -> Saver:
    return Saver(run, network="grasp", config=GraspConfig(width=8))


def test_what_is_donated_or_changed_while_a_step_is_written_does_not_change_it(
    slow: Slow, tmp_path: pathlib.Path
) -> None:
    again = jax.jit(lambda x: x + 1, donate_argnums=0)
    on_device, here = jnp.arange(1000.0), np.zeros(3)
    with _saver(tmp_path) as saver:
        saver.save(1, {"model": {"device": on_device, "here": here}}, extra={})
        assert slow.begun.acquire(timeout=PATIENCE)
        for _ in range(3):
            on_device = again(on_device)
        here += 1
        jax.block_until_ready(on_device)
        assert not slow.saved, "saving waited to be written"
        slow.allowed.release()
    ((_, model),) = slow.saved
    np.testing.assert_array_equal(model["device"], np.arange(1000.0))
    np.testing.assert_array_equal(model["here"], 0)


def test_one_step_is_written_at_a_time_and_the_last_is_waited_for(slow: Slow, tmp_path: pathlib.Path) -> None:
    model = {"model": {"x": np.zeros(1)}}
    with _saver(tmp_path) as saver:
        saver.save(1, model, extra={})
        second = threading.Thread(target=lambda: saver.save(2, model, extra={}))
        second.start()
        assert slow.begun.acquire(timeout=PATIENCE) and not slow.begun.acquire(timeout=0.2)
        slow.allowed.release(2)
        second.join(PATIENCE)
    assert [step for step, _ in slow.saved] == [1, 2]


def test_what_kept_a_step_from_being_saved_is_said_at_the_next_or_at_the_end(
    slow: Slow, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model: dict[str, Any] = {"model": {}}
    slow.allowed.release(9)
    with pytest.raises(UserError, match="step 13"), _saver(tmp_path) as saver:
        saver.save(13, model, extra={})
        with pytest.raises(UserError, match="step 13"):
            saver.save(14, model, extra={})
        saver.save(13, model, extra={})
    with pytest.raises(KeyboardInterrupt), _saver(tmp_path) as saver:
        saver.save(13, model, extra={})
        raise KeyboardInterrupt
    assert capsys.readouterr().err == "warning: step 13 cannot be saved\n"
    assert [step for step, _ in slow.saved] == [13, 13, 13]


def test_random_keys_and_numbers_come_back(tmp_path: pathlib.Path) -> None:
    state = {"key": jax.random.key(3), "count": jnp.int32(7), "half": jnp.ones(2, jnp.bfloat16)}
    with _saver(tmp_path) as saver:
        saver.save(5, {"model": state}, extra={"seed": 1})
    folder, meta = checkpoint.newest(tmp_path)  # type: ignore[misc]
    assert meta["step"] == 5 and meta["seed"] == 1
    fresh = {"key": jax.random.key(0), "count": jnp.int32(0), "half": jnp.zeros(2, jnp.bfloat16)}
    restored = checkpoint.restore(folder, "model", fresh)
    assert jax.random.uniform(restored["key"]) == jax.random.uniform(state["key"])
    assert int(restored["count"]) == 7 and restored["half"].dtype == jnp.bfloat16 and (restored["half"] == 1).all()


def test_a_step_has_its_name_only_when_it_is_synced(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that cannot be synced is a step that cannot be saved; the steps before stay."""
    with _saver(tmp_path) as saver:
        saver.save(1, {"model": {"x": np.zeros(3)}}, extra={})

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"), _saver(tmp_path) as saver:
        saver.save(2, {"model": {"x": np.zeros(3)}}, extra={})
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["00000001"]


def test_a_save_that_fails_prints_nothing_of_closed_event_loops_and_all_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """TensorStore's threads report to a loop that Orbax has closed, during a failed save and after it."""
    printed: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda each: printed.append(str(each.exc_value)))

    def report(text: str) -> None:
        sys.unraisablehook(types.SimpleNamespace(exc_value=RuntimeError(text)))  # type: ignore[arg-type]

    with quiet.failed_saves():
        report("Event loop is closed")
    report("Event loop is closed")
    assert printed == ["Event loop is closed"], "a save that succeeds leaves things as they were"
    with pytest.raises(ValueError, match="full"), quiet.failed_saves():
        raise ValueError("full")
    report("Event loop is closed")
    report("something else")
    assert printed[1:] == ["something else"]


def test_writes_that_nobody_waits_for_are_not_reported_after_a_save_that_failed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def fails() -> None:
        raise ValueError("full")

    async def forget() -> None:
        task = asyncio.ensure_future(fails())
        several = asyncio.gather(fails())
        await asyncio.sleep(0.01)
        del task, several
        gc.collect()

    gc.collect()  # what tests before this one have forgotten
    caplog.clear()
    with pytest.raises(ValueError, match="full"), quiet.failed_saves():
        raise ValueError("full")
    asyncio.run(forget())
    logging.getLogger("asyncio").error("something else")
    assert [record.getMessage() for record in caplog.records if record.name == "asyncio"] == ["something else"]
    with quiet.failed_saves():
        pass
    asyncio.run(forget())
    assert "never retrieved" in caplog.records[-1].getMessage()
