"""Files that are either complete or absent: JSON, checksums, and folders that belong to one configuration."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import os
import pathlib
import secrets
from typing import Any

from dipn_jax.errors import UserError


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
    for folder in (pathlib.Path(__file__).parent, *folders):
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def file_sha256(path: pathlib.Path) -> str:
    """Return the SHA-256 of a file's bytes, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Write a file under a temporary name, sync it, then rename it."""
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


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write a JSON file atomically, keys in the given order."""
    write_atomically(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: pathlib.Path, *, wanted: type = dict) -> Any:
    """Return what a JSON file holds.

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
                "same options and data to continue"
            )
    write_json(path, mine)
