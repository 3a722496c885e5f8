"""Only one process at a time may use a run's or an evaluation's folder; `OUT/owner.json` names it."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import pathlib
import socket
from collections.abc import Iterator

from dipn_jax.commands import console
from dipn_jax.errors import InUse
from dipn_jax.system import files, temporary, typed

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextlib.contextmanager
def owned(out: pathlib.Path) -> Iterator[None]:
    """Own a folder, which is made if need be, within a `with` statement; dead processes' temporary files are deleted.

    A folder that was made and is still empty at the end is deleted.

    The file is locked, so that it is free once its owner is dead; where files cannot be locked, it is made exclusively,
    and an owner of this host is looked for.

    Raises:
      InUse: somebody else has it.
    """
    made = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    descriptor, path = _locked(out / "owner.json")
    try:
        os.ftruncate(descriptor, 0)
        started = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        about = {"host": socket.gethostname(), "pid": os.getpid(), "started": started}
        os.write(descriptor, (json.dumps(about) + "\n").encode())
        each = [place for films in out.glob("*/episodes") for place in (films.parent, films)]  # as a sweep has them
        for folder in (out, out / "checkpoints", out / "episodes", *each):
            temporary.delete_leftovers(folder)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)
        if made:
            with contextlib.suppress(OSError):  # there is something in it
                out.rmdir()


def _locked(path: pathlib.Path) -> tuple[int, pathlib.Path]:
    """Return a descriptor of a file that this process has to itself, and its path."""
    while True:
        if fcntl is None:
            return _exclusive(path.with_name("owner.exclusive.json"))
        if path.exists():
            files.require_regular(path)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise _taken(path) from None
        except OSError:  # a file system without locks
            os.close(descriptor)
            path.unlink(missing_ok=True)
            return _exclusive(path.with_name("owner.exclusive.json"))
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor, path
        os.close(descriptor)  # its owner deleted it between our opening and locking it


def _exclusive(path: pathlib.Path) -> tuple[int, pathlib.Path]:
    """Return a descriptor of the file and its path, made by this process; a dead owner's of this host is replaced."""
    console.warn(
        f"{path.parent}: its file system has no locks; {path.name} is deleted at the end, by you after a crash"
    )
    if _dead(path):
        path.unlink(missing_ok=True)
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644), path
    except FileExistsError:
        raise _taken(path) from None


def _read(path: pathlib.Path) -> dict[str, object]:
    """Return the content of the file; nothing if it is damaged or gone."""
    try:
        found = typed.parse(path.read_bytes())
    except (OSError, typed.Misfit):
        return {}
    return found if isinstance(found, dict) else {}


def _dead(path: pathlib.Path) -> bool:
    """Return whether the owner was a process of this host that has ended."""
    owner = _read(path)
    pid = owner.get("pid")
    if owner.get("host") != socket.gethostname() or not isinstance(pid, int) or pid <= 0:
        return False
    return not temporary.alive(pid)


def _taken(path: pathlib.Path) -> InUse:
    """Return the error that says who has the folder."""
    owner = _read(path)
    who = (
        ", ".join(f"{name} {owner[name]}" for name in ("host", "pid", "started") if name in owner) or "another process"
    )
    return InUse(f"{path.parent}: in use by {who}; wait for it or give another --out (if it is dead, delete {path})")
