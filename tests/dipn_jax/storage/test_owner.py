"""A run's folder has one owner at a time, with locks and without."""

import errno
import fcntl
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
from typing import Any

import pytest
from dipn_jax.train import log

from dipn_jax.errors import InUse
from dipn_jax.storage import owner
from dipn_jax.system import temporary

HOLD = """
import pathlib, sys, time
from dipn_jax.storage import owner
with owner.owned(pathlib.Path(sys.argv[1])):
    print("mine", flush=True)
    time.sleep(600)
"""


def _no_locks(*_: Any) -> None:
    raise OSError(errno.ENOLCK, "no locks")


def test_the_second_is_told_who_has_it_and_a_dead_owner_does_not_block(tmp_path: pathlib.Path) -> None:
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None and other.stdout.readline() == "mine\n"
        who = f"in use by host {socket.gethostname()}, pid {other.pid}, started 2"
        with pytest.raises(InUse, match=who), owner.owned(tmp_path):
            pass
    finally:
        other.send_signal(signal.SIGKILL)
        other.wait()
    assert (tmp_path / "owner.json").exists()
    with owner.owned(tmp_path):
        assert json.loads((tmp_path / "owner.json").read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())


def test_without_locks_the_file_is_made_exclusively_and_that_is_said(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fcntl, "flock", _no_locks)
    (tmp_path / "run").mkdir()
    with owner.owned(tmp_path / "run"):
        assert "no locks" in capsys.readouterr().err
        with pytest.raises(InUse, match=f"pid {os.getpid()}"), owner.owned(tmp_path / "run"):
            pass
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    path = tmp_path / "run" / "owner.exclusive.json"
    path.write_text(json.dumps({"host": "elsewhere", "pid": ended.pid, "started": "today"}))
    with pytest.raises(InUse, match="host elsewhere"), owner.owned(tmp_path / "run"):
        pass
    path.write_text(json.dumps({"host": socket.gethostname(), "pid": ended.pid, "started": "today"}))
    with owner.owned(tmp_path / "run"):
        assert json.loads(path.read_text())["pid"] == os.getpid()


def test_a_system_without_file_locks_has_owners_all_the_same(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, "fcntl", None)
    monkeypatch.setattr(log, "resource", None)
    with owner.owned(tmp_path / "run"), pytest.raises(InUse, match="in use"), owner.owned(tmp_path / "run"):
        pass
    assert not (tmp_path / "run").exists() and log._peak() == {}


def test_what_dead_processes_left_is_swept_at_the_next_start(tmp_path: pathlib.Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    steps, host = tmp_path / "checkpoints", temporary._host()
    living = f"{host}-{os.getppid()}-0a1b2c3d"
    for process in (f"{host}-{ended.pid}-0a1b2c3d", living, "elsewher-1-0a1b2c3d"):
        (steps / f".00000003.{process}.tmp" / "model").mkdir(parents=True)
        (tmp_path / f".partial.npz.{process}.tmp").touch()
    for films in (tmp_path / "episodes", tmp_path / "0.05" / "episodes"):
        films.mkdir(parents=True)
        for folder in {films, films.parent}:
            (folder / f".000.npz.{host}-{ended.pid}-0a1b2c3d.tmp").touch()
    (tmp_path / ".mine.tmp").touch()

    def left() -> set[str]:
        return {p.name for p in tmp_path.rglob("*.tmp")}

    temporary.delete_leftovers(tmp_path, shared=True)
    assert {name for name in left() if name.startswith(".partial")} == {
        f".partial.npz.{living}.tmp",
        ".partial.npz.elsewher-1-0a1b2c3d.tmp",
    }
    with owner.owned(tmp_path):
        pass
    assert left() == {".mine.tmp", f".00000003.{living}.tmp", f".partial.npz.{living}.tmp"}
    assert temporary.temporary_path(tmp_path / "a").name.startswith(f".a.{host}-{os.getpid()}-")


@pytest.mark.parametrize("text", ["[" * 100_000, "[1]", "{", "\x00", '{"pid": "x"}'])
def test_a_damaged_owner_file_names_nobody(text: str, tmp_path: pathlib.Path) -> None:
    (tmp_path / "owner.json").write_text(text)
    assert not owner._dead(tmp_path / "owner.json")
    assert "\n" not in str(owner._taken(tmp_path / "owner.json"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
def test_an_owner_file_that_is_none_is_named(tmp_path: pathlib.Path) -> None:
    os.mkfifo(tmp_path / "owner.json")
    with pytest.raises(OSError, match=r"not a regular file.*owner\.json"), owner.owned(tmp_path):
        pass
