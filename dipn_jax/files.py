"""Files that are whole or not there: JSON, checksums, and folders that belong to one configuration."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import os
import pathlib
import secrets
import shutil
from typing import Any

from dipn_jax.errors import UserError


def package_versions() -> dict[str, str]:
    """Versions of the packages that results depend on."""
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
    """SHA-256 of the packages' versions, the library's sources and those in other `folders`, in hex."""
    digest = hashlib.sha256(str(package_versions()).encode())
    for folder in (pathlib.Path(__file__).parent, *folders):
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def file_sha256(path: pathlib.Path) -> str:
    """SHA-256 of a file's bytes, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Write under a temporary name, sync, rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # workers in containers may share process numbers
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)


def sweep(folder: pathlib.Path) -> None:
    """Delete the temporary files and folders in `folder` (`.NAME.PID[-...].tmp`) whose process is dead.

    A process of another machine looks dead here: call it only where this process owns the folder.
    """
    for path in folder.glob(".*.tmp") if folder.is_dir() else []:
        number = path.name.split(".")[-2].partition("-")[0]
        if number.isdecimal() and int(number) != os.getpid() and not alive(int(number)):
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


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write JSON atomically, keys in the given order."""
    write_atomically(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: pathlib.Path, *, wanted: type = dict) -> Any:
    """A JSON file.

    Raises:
      UserError: it is missing, is not JSON, or is not a `wanted` at its top.
    """
    try:
        value = json.loads(path.read_text())
    except FileNotFoundError:
        raise UserError(f"{path}: not found; give a folder that the command before this one wrote") from None
    except (OSError, ValueError):
        raise UserError(f"{path}: damaged, not JSON; delete it or give another folder") from None
    if not isinstance(value, wanted):
        raise UserError(f"{path}: holds a {type(value).__name__}, want a {wanted.__name__}; give another folder")
    return value


def claim(out: pathlib.Path, identity: dict[str, Any], *, free: tuple[str, ...] = ()) -> None:
    """Write `out/config.json`, or check that the folder was begun with the same one.

    Args:
      out: folder of a data set or a run.
      identity: JSON-able, flat: everything the content depends on.
      free: keys that may change.

    Raises:
      UserError: the folder was begun with something else.
    """
    path, mine = out / "config.json", json.loads(json.dumps(identity))
    if path.exists():
        theirs = read_json(path)
        different = [key for key in mine if key not in free and theirs.get(key) != mine[key]]
        if different:
            key = different[0]
            raise UserError(
                f"{out}: begun with {key}={theirs.get(key)}, asked for {key}={mine[key]}; give another --out, or the "
                "same options and data to go on"
            )
    write_json(path, mine)
