"""An interrupted evaluation goes on where it stopped: its state is kept beside its results until it ends."""

from __future__ import annotations

import json
import pathlib
import pickle
from typing import Any

from dipn_jax import records


class Partial:
    """The state of an evaluation under way, in `OUT/partial.pickle`; that of other settings is not taken up."""

    def __init__(self, out: pathlib.Path, settings: dict[str, Any]) -> None:
        """Look for a state.

        Args:
          out: folder of the evaluation.
          settings: everything the results depend on.
        """
        self.path = out / "partial.pickle"
        self.identity = json.dumps({k: str(v) for k, v in settings.items()} | records.package_versions())

    def load(self, fresh: Any) -> Any:
        """The state kept, or `fresh` where there is none for these settings."""
        try:
            identity, state = pickle.loads(self.path.read_bytes())
        except (OSError, pickle.UnpicklingError, EOFError, ValueError, TypeError):
            return fresh
        return state if identity == self.identity else fresh

    def save(self, state: Any) -> None:
        """Keep `state` (anything that pickles), atomically."""
        records.write_atomically(self.path, pickle.dumps((self.identity, state)))

    def finish(self) -> None:
        """The results are written: drop the state."""
        self.path.unlink(missing_ok=True)
