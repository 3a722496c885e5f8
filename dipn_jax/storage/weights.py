"""Write weights to one file of the safetensors format, for programs without JAX. This package does not read it."""

from __future__ import annotations

import json
import pathlib
from typing import Any

import numpy as np
import safetensors.numpy
from flax import nnx

from dipn_jax.commands import option_paths
from dipn_jax.networks import described
from dipn_jax.storage import checkpoint
from dipn_jax.system import files

FORMAT = "dipn-jax weights 1"
"""Entry `format` of the file's metadata."""


def arrays(model: nnx.Module) -> dict[str, np.ndarray]:
    """Return parameters and batch statistics of a network by their dotted names."""
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    return {".".join(map(str, path)): np.asarray(leaf[...]) for path, leaf in nnx.to_flat_state(state)}


def write(run: pathlib.Path, out: pathlib.Path, *, network: str) -> None:
    """Write the weights of the newest whole step of a run, with what a program needs to run them.

    The metadata of the file are text: `format`, `network`, `step`, `run_sha256` (of the step's metadata, as evaluations
    record it), `weights_sha256`, `layout`; and JSON: `config`, `inputs`, `outputs`, `constants`, `versions`.

    Args:
      run: a run's folder, or `builtin`.
      out: the file, NAME.safetensors.
      network: a key of `checkpoint.NETWORKS`.

    Raises:
      UserError: as `checkpoint.load_network`; or `out` cannot be a file.
    """
    option_paths.require_file(out, ".safetensors", option="out")
    model: Any = checkpoint.load_network(run, network=network)
    where = checkpoint.find(pathlib.Path(run), network=network)
    folder, meta = checkpoint.newest(where)  # type: ignore[misc]
    about = {
        "format": FORMAT,
        "network": network,
        "step": str(meta["step"]),
        "run_sha256": files.file_sha256(folder / "meta.json"),
        "weights_sha256": checkpoint.digest(model),
        "layout": described.LAYOUT,
        "config": json.dumps(meta["network_config"]),
        "versions": json.dumps(meta["versions"]),
        **{key: json.dumps(value) for key, value in described.described(network, model.config).items()},
    }
    files.write_atomically(out, _in_order(safetensors.numpy.save(arrays(model), metadata=about)))


def _in_order(data: bytes) -> bytes:
    """Return a safetensors file with its metadata sorted; the library writes them in another order every time.

    The file is the length of its header (8 bytes), the header (JSON, filled up with spaces), and the arrays.
    """
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[end:]
