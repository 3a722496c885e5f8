"""Work that was interrupted goes on where it stopped: its state is kept beside its results until it ends."""

from __future__ import annotations

import json
import pathlib
import pickle
from collections.abc import Sequence
from typing import Any

from dipn_jax import files
from dipn_jax.storage import checkpoint


class Partial:
    """The state of work under way, in `OUT/partial.pickle`; that of other settings is not taken up."""

    def __init__(self, out: pathlib.Path, settings: dict[str, Any], *, inputs: Sequence[pathlib.Path] = ()) -> None:
        """Look for a state.

        Args:
          out: folder of the results.
          settings: options that the results depend on.
          inputs: files and runs that they depend on; their content counts, not their name.
        """
        self.path = out / "partial.pickle"
        content = [_fingerprint(path) for path in inputs]
        named = {k: str(v) for k, v in settings.items()}
        self.identity = json.dumps([named, content, files.package_versions()])

    def load(self, fresh: Any) -> Any:
        """The state kept, or `fresh` where there is none for these settings."""
        try:
            identity, state = pickle.loads(self.path.read_bytes())
        except Exception:  # a foreign or damaged pickle can raise anything; then there is no state
            return fresh
        return state if identity == self.identity else fresh

    def save(self, state: Any) -> None:
        """Keep `state` (anything that pickles), atomically."""
        files.write_atomically(self.path, pickle.dumps((self.identity, state)))

    def finish(self) -> None:
        """The results are written: drop the state."""
        self.path.unlink(missing_ok=True)


def _fingerprint(path: pathlib.Path) -> str:
    """Of a file, or of the newest checkpoint of a run."""
    if path.is_file():
        return files.file_sha256(path)
    found = checkpoint.newest(path)
    return files.file_sha256(found[0] / "meta.json") if found else "none"
