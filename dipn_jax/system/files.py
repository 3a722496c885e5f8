"""Files that are either complete or absent: JSON, checksums, and folders that belong to one configuration."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import functools
import hashlib
import importlib.metadata
import json
import os
import pathlib
import re
import shutil
import stat
import time
from collections.abc import Iterator
from typing import Any

from dipn_jax.errors import UserError
from dipn_jax.system import addresses, temporary, typed

EMPTY_PATH_MESSAGE = "'': an empty path, as of a variable that is not set; give a path, or . for this folder"
"""What is said of an empty path."""
_BUILTIN = re.compile(r"builtin(@(best|\d+))?")


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that results depend on."""
    return dict(_versions())


@functools.cache
def _versions() -> dict[str, str]:
    names = ("dipn-jax", "jax", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")
    found = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


def code_digest(*folders: pathlib.Path) -> str:
    """Return the SHA-256, in hex, of the packages' versions, the library's sources and those in other `folders`."""
    digest = hashlib.sha256(str(package_versions()).encode())
    for folder in (pathlib.Path(__file__).parents[1], *folders):
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.h")]):
            digest.update(read_bytes(path))
    return digest.hexdigest()


def absolute(path: pathlib.Path | str) -> pathlib.Path:
    """Return a path that a user gave with `~` expanded, and absolute; links in it stay.

    Raises:
      UserError: it is empty, there is no such home folder, it is a URL, its name is not UTF-8, or it is a link that
        leads back to itself.
    """
    path = not_empty(path)
    if address := addresses.url(path):
        raise UserError(f"{address}: a URL, which this option does not take; give a path")
    try:
        found = path.expanduser().absolute()
    except RuntimeError:
        raise UserError(f"{path}: there is no home folder for ~; give the folder's full path") from None
    try:
        os.fsencode(found).decode("utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{path}: a name that is not UTF-8; rename it, or give another path") from None
    try:
        found.stat()
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise UserError(f"{path}: a link that leads back to itself; delete it, or give another path") from None
    return found


def require_locale(path: pathlib.Path) -> None:
    """Raise a UserError where the locale reads a path's name otherwise than as UTF-8, as libraries of C++ read it."""
    if str(path).encode("utf-8", "replace") != os.fsencode(path):
        raise UserError(f"{path}: checkpoints of this name need a locale with UTF-8; set PYTHONUTF8=1, or rename it")


def not_empty(path: pathlib.Path | str) -> pathlib.Path:
    """Return a path that a user gave; an empty text, which `pathlib` takes for the folder that we are in, is refused.

    Raises:
      UserError: it is an empty text.
    """
    if path == "":
        raise UserError(EMPTY_PATH_MESSAGE)
    return pathlib.Path(path)


def with_absolute_paths(value: Any, *, urls: bool = False) -> Any:
    """Return a parsed option with every path in it expanded and absolute; the name `builtin` is no path.

    Args:
      value: the option.
      urls: whether it may be a URL, which stays as it is.

    Raises:
      UserError: as `absolute`.
    """
    if isinstance(value, pathlib.Path):
        return value if _BUILTIN.fullmatch(str(value)) or (urls and addresses.url(value)) else absolute(value)
    if isinstance(value, tuple):
        return tuple(with_absolute_paths(each, urls=urls) for each in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        return dataclasses.replace(value, **{name: with_absolute_paths(each) for name, each in fields.items()})
    return value


def cache() -> pathlib.Path | None:
    """Return our folder in the user's cache (`XDG_CACHE_HOME`, else `~/.cache`); None for a user without a home."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return None if home.startswith("~") else pathlib.Path(home) / "dipn-jax"


def file_sha256(path: pathlib.Path) -> str:
    """Return the SHA-256 of a file's bytes, in hex."""
    require_regular(path)
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Write a file under a temporary name, then `move` it."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def replacing(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Return a context whose value is a temporary path: what is written there gets the name `path` at the end.

    Where something is raised, nothing of it is left.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    there = temporary.temporary_path(path)
    try:
        yield there
        move(there, path)
    except OSError as error:  # a write that fails does not say where
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        there.unlink(missing_ok=True)


def move(source: pathlib.Path, target: pathlib.Path) -> None:
    """Rename a file or a folder durably: its content is synced first, then its name.

    So a power cut leaves all of it under the new name, or nothing.
    """
    for path in (*source.rglob("*"), source):
        _sync(path)
    source.rename(target)
    _sync(target.parent)


def _sync(path: pathlib.Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk; some file systems sync no folders."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if not path.is_dir() or error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def require_regular(path: pathlib.Path) -> None:
    """Raise an OSError where a file is a pipe, a socket or a device, which could be read for ever, or not there.

    A folder passes; who reads it gets the system's own error.
    """
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def read_bytes(path: pathlib.Path) -> bytes:
    """Return what a regular file holds."""
    require_regular(path)
    return path.read_bytes()


def read_text(path: pathlib.Path) -> str:
    """Return a text file's content: UTF-8, with or without a byte-order mark, whatever the locale says."""
    require_regular(path)
    return path.read_text(encoding="utf-8-sig")


def write_text(path: pathlib.Path, text: str) -> None:
    """Write a text file atomically, as UTF-8 whatever the locale says.

    Where the locale knows no UTF-8, Python has the bytes of a path's name as surrogates: they become those bytes again.
    """
    write_atomically(path, text.encode("utf-8", "surrogateescape"))


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write a JSON file atomically, keys in the given order."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: pathlib.Path, *, wanted: typed.Form = dict) -> Any:
    """Return what a JSON file holds.

    Raises:
      UserError: it is missing, is not JSON, or does not have the form `wanted`.
    """
    try:
        return typed.check(typed.parse(read_bytes(path)), wanted)
    except FileNotFoundError:
        raise UserError(f"{path}: not found; give a folder that the command before this one wrote") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); mend that, or give another folder") from None
    except typed.Misfit as error:
        raise UserError(f"{path}: damaged, {error}; delete it or give another folder") from None


def read_lines(path: pathlib.Path, *, wanted: typed.Form = dict) -> list[Any]:
    """Return what the lines of a log hold, each of them JSON.

    Raises:
      UserError: it is missing, or a line of it is not JSON or does not have the form `wanted`.
    """
    found: list[Any] = []
    try:
        for line in read_text(path).splitlines():
            found.append(typed.check(typed.parse(line), wanted))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give the --out of a dipn-train command") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: damaged, not UTF-8; train again, or give another --out") from None
    except typed.Misfit as error:
        raise UserError(
            f"{path}: damaged, line {len(found) + 1}: {error}; train again, or give another --out"
        ) from None
    return found


def claim(out: pathlib.Path, identity: dict[str, Any], *, free: tuple[str, ...] = (), write: bool = True) -> None:
    """Write `out/config.json`, or check that the folder was begun with the same one.

    Args:
      out: folder of a data set or a run.
      identity: JSON-able, flat: everything the content depends on.
      free: keys that may change.
      write: not only check.

    Raises:
      UserError: the folder was begun with something else.
    """
    path, mine = out / "config.json", json.loads(json.dumps(identity))
    if path.exists():
        theirs = read_json(path)
        different = [key for key in {**mine, **theirs} if key not in free and theirs.get(key) != mine.get(key)]
        if different:
            key = different[0]
            begun = typed.one_line(str(theirs.get(key)), most=200)
            raise UserError(
                f"{out}: begun with {key}={begun}, asked for {key}={mine.get(key)}; give another --out, or the "
                "same options and data to continue"
            )
    if write:
        write_json(path, mine)


def remove_folder(folder: pathlib.Path) -> None:
    """Delete a folder into which threads of a save that failed may still be writing for a moment."""
    for pause in (0.0, 0.1, 0.3, 1.0, 2.0):
        time.sleep(pause)
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
