"""Traced programs on disk. XLA's own cache saves compiling; most of the rest of a first call is tracing, in Python."""

from __future__ import annotations

import hashlib
import pathlib
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax import export

from dipn_jax.structs import Array
from dipn_jax.system import files

_CODE_AT_IMPORT = files.code_digest()
"""Digest of the sources, taken while they are imported: editing them later does not change what this process traces."""


def program(
    function: Callable[..., tuple[Array, ...]], arguments: Sequence[Array], *, what: str, donate: Sequence[int]
) -> Callable[..., tuple[Array, ...]]:
    """Return `jax.jit(function)`, with the trace that an earlier process has kept on disk if there is one.

    Args:
      function: of arrays, for one device, of the default kind.
      arguments: arrays as it will be called with; only shapes and types matter.
      what: everything else that its trace depends on, such as the present default precision.
      donate: arguments whose memory the result takes over.

    Returns:
      A function of the same arguments. Traces are kept in `traced` in the folder of JAX's compilation cache; without
      such a folder, or where it cannot be written, nothing is kept. A file that cannot be read is written anew.
    """
    shapes = [jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype) for leaf in arguments]
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if not cache:
        return jax.jit(function, donate_argnums=tuple(donate))
    about = [_CODE_AT_IMPORT, jax.default_backend(), str(jax.config.read("jax_enable_x64")), what, str(shapes)]
    key = hashlib.sha256("\n".join(about).encode()).hexdigest()
    path = pathlib.Path(cache) / "traced" / key
    try:
        traced = export.deserialize(bytearray(files.read_bytes(path)))
    except Exception:  # not there or damaged: what a damaged one raises is not documented
        try:
            traced = export.export(jax.jit(function))(*shapes)
            files.write_atomically(path, bytes(traced.serialize()))
        except (OSError, ValueError):  # a folder that cannot be written, a device whose programs cannot be kept
            return jax.jit(function, donate_argnums=tuple(donate))
    else:
        # JAX finds LAPACK when it lowers something that calls it; a program lowered elsewhere would crash without
        jax.block_until_ready(jax.numpy.linalg.cholesky(jax.numpy.eye(2)))
    return jax.jit(traced.call, donate_argnums=tuple(donate))
