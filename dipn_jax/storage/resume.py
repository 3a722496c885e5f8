"""State of unfinished work, kept beside its results, so that interrupted work continues where it stopped."""

from __future__ import annotations

import json
import pathlib
import pickle
from collections.abc import Sequence
from typing import Any

from dipn_jax import files
from dipn_jax.storage import checkpoint


class Partial:
    """The state of unfinished work, in `OUT/partial.pickle`; a state of other settings is ignored."""

    def __init__(self, out: pathlib.Path, settings: dict[str, Any], *, inputs: Sequence[pathlib.Path] = ()) -> None:
        """Prepare to load and save the state of work with these settings.

        Args:
          out: folder of the results.
          settings: options that the results depend on; those that are paths are recorded by `inputs`.
          inputs: files and runs that the results depend on, by content, not by name.
        """
        self.path = out / "partial.pickle"
        content = [_fingerprint(path) for path in inputs]
        self._paths = {key for key, value in settings.items() if _has_path(value)}
        named = {key: str(value) for key, value in settings.items() if key not in self._paths}
        self.identity = json.dumps([named, content, files.package_versions()])

    def load(self, fresh: Any) -> Any:
        """Return the state kept, or `fresh` if there is none for these settings."""
        try:
            identity, state = pickle.loads(self.path.read_bytes())
            named, *others = json.loads(identity)  # earlier versions wrote the paths, too, as they were given
            identity = json.dumps([{k: v for k, v in named.items() if k not in self._paths}, *others])
        except Exception:  # a foreign or damaged pickle can raise anything; then there is no state
            return fresh
        return state if identity == self.identity else fresh

    def save(self, state: Any) -> None:
        """Keep `state` (anything that can be pickled), atomically."""
        files.write_atomically(self.path, pickle.dumps((self.identity, state)))

    def finish(self) -> None:
        """Delete the state, once the results are written."""
        self.path.unlink(missing_ok=True)


def _has_path(value: Any) -> bool:
    """Return whether an option is a path or a tuple of some."""
    return isinstance(value, pathlib.Path) or (isinstance(value, tuple) and any(map(_has_path, value)))


def _fingerprint(path: pathlib.Path) -> str:
    """Return the SHA-256 of a file, or of the newest checkpoint of a run."""
    if path.is_file():
        return files.file_sha256(path)
    found = checkpoint.newest(path)
    return files.file_sha256(found[0] / "meta.json") if found else "none"
