"""State of unfinished work, kept beside its results, so that interrupted work continues where it stopped."""

from __future__ import annotations

import importlib.util
import json
import pathlib
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import console
from dipn_jax.storage import checkpoint, serialization
from dipn_jax.system import files

FORMAT_VERSION = 1
"""Version of the format; a state of another version is not taken up."""


class Partial:
    """The state of unfinished work, in `OUT/partial.npz`; one of other settings, inputs or sources is not taken up.

    `named` holds the settings that are no paths, `content` a digest of each input; `networks` step and digest of each
    run among the inputs, `files` the SHA-256 of each file, by their names; `code` is the digest of our sources and of
    the versions of packages.
    """

    def __init__(
        self,
        out: pathlib.Path,
        settings: dict[str, Any],
        *,
        inputs: Sequence[pathlib.Path] = (),
        part: tuple[int, int] | None = None,
    ) -> None:
        """Prepare to load and save the state of work with these settings.

        Args:
          out: folder of the results.
          settings: options that the results depend on; those that are paths are recorded by `inputs`.
          inputs: files and runs that the results depend on, by content, not by name.
          part: number of this part of the work and how many there are, where others do the rest.
        """
        self.path = out / "partial.npz"
        self.content = [_fingerprint(path) for path in inputs]
        self.named = {key: str(value) for key, value in settings.items() if not _has_path(value)}
        self.identity = json.dumps([FORMAT_VERSION, self.named, self.content, *([part] if part else [])])
        self.networks = {str(path): checkpoint.used(path) for path in inputs if not path.is_file()}
        self.files = {str(path): files.file_sha256(path) for path in inputs if path.is_file()}
        self.code = files.code_digest(*_stages())

    def load(self, fresh: Any) -> Any:
        """Return the state kept, or `fresh` if there is none for these settings, with a line if it cannot be used."""
        try:
            kept = serialization.loads(files.read_bytes(self.path))
            identity, code, state = kept["identity"], kept["code"], kept["state"]
        except FileNotFoundError:
            return fresh
        except Exception:  # a damaged file can raise anything
            console.warn(f"{self.path}: damaged, or kept by another version; begins anew")
            return fresh
        if identity != self.identity:
            console.warn(f"{self.path}: kept with other options or networks than now; begins anew")
            return fresh
        if code != self.code:
            console.warn(f"{self.path}: kept by other sources or versions of packages than now; begins anew")
            return fresh
        return state

    def save(self, state: Any) -> None:
        """Keep `state` (what `serialization.dumps` takes), atomically."""
        files.write_atomically(
            self.path, serialization.dumps({"identity": self.identity, "code": self.code, "state": state})
        )

    def finish(self) -> None:
        """Delete the kept state, and the `.pickle` of earlier versions, once results are written."""
        self.path.unlink(missing_ok=True)
        self.path.with_suffix(".pickle").unlink(missing_ok=True)


def _stages() -> list[pathlib.Path]:
    """Return the folders of the stages that keep states."""
    found = [importlib.util.find_spec(f"dipn_jax.{stage}") for stage in ("train", "eval")]
    return [pathlib.Path(each.origin).parent for each in found if each and each.origin]


def _has_path(value: Any) -> bool:
    """Return whether an option is a path or a tuple of some."""
    return isinstance(value, pathlib.Path) or (isinstance(value, tuple) and any(map(_has_path, value)))


def _fingerprint(path: pathlib.Path) -> str:
    """Return the SHA-256 of a file, or of the newest checkpoint of a run."""
    if path.is_file():
        return files.file_sha256(path)
    found = checkpoint.used(path)
    return str(found["digest"]) if found else "none"
