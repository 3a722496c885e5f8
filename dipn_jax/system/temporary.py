"""Temporary files: their names, and what dead processes have left. Importing this imports nothing of ours."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pathlib
import secrets
import shutil
import socket


def temporary_path(path: pathlib.Path) -> pathlib.Path:
    """Return a temporary path in the folder of `path`: `.NAME.HOST-PID-TOKEN.tmp`."""
    token = secrets.token_hex(4)  # workers in containers may share process numbers
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{token}.tmp")


@functools.cache
def _host() -> str:
    """Return eight digits that identify this machine and container, in which process numbers are unique."""
    known = [socket.gethostname()]
    with contextlib.suppress(OSError):  # not Linux
        known.append(pathlib.Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8"))
        known.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("".join(known).encode()).hexdigest()[:8]


def delete_leftovers(folder: pathlib.Path, *, shared: bool = False) -> None:
    """Delete the temporary files and folders in `folder` that dead processes have left.

    Args:
      folder: where they are; it need not exist.
      shared: other machines may be writing there, so their files stay; otherwise these are deleted, too.
    """
    for path in folder.glob(".*.tmp") if folder.is_dir() else []:
        host, number, *_ = [*path.name.split(".")[-2].split("-"), ""]
        if not number.isdecimal():
            continue
        dead = not alive(int(number)) if host == _host() else not shared
        if dead:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def alive(process: int) -> bool:
    """Return whether there is a process of this number on this machine."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True
