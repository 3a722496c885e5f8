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
          settings: options that the results depend on.
          inputs: files and runs that the results depend on, by content, not by name.
        """
        self.path = out / "partial.pickle"
        content = [_fingerprint(path) for path in inputs]
        named = {k: str(v) for k, v in settings.items()}
        self.identity = json.dumps([named, content, files.package_versions()])

    def load(self, fresh: Any) -> Any:
        """Return the state kept, or `fresh` if there is none for these settings."""
        try:
            identity, state = pickle.loads(self.path.read_bytes())
        except Exception:  # a foreign or damaged pickle can raise anything; then there is no state
            return fresh
        return state if identity == self.identity else fresh

    def save(self, state: Any) -> None:
        """Keep `state` (anything that can be pickled), atomically."""
        files.write_atomically(self.path, pickle.dumps((self.identity, state)))

    def finish(self) -> None:
        """Delete the state, once the results are written."""
        self.path.unlink(missing_ok=True)


def _fingerprint(path: pathlib.Path) -> str:
    """Return the SHA-256 of a file, or of the newest checkpoint of a run."""
    if path.is_file():
        return files.file_sha256(path)
    found = checkpoint.newest(path)
    return files.file_sha256(found[0] / "meta.json") if found else "none"
