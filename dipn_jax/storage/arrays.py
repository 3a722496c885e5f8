"""Read and write files of named arrays (`npz`); a `Misfit` says which array is missing or wrong."""

from __future__ import annotations

import dataclasses
import io
import pathlib
from collections.abc import Mapping

import numpy as np

from dipn_jax.system import files, typed


@dataclasses.dataclass(frozen=True)
class Form:
    """The types and the shape that an array must have."""

    kinds: str  # kinds of NumPy: f float, i int, u unsigned, b bool, U text
    shape: tuple[int | str, ...]  # lengths, or the name of one: the same in all arrays of a file


def dumps(named: Mapping[str, np.ndarray]) -> bytes:
    """Return arrays as the bytes of a file that `read` reads."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **named)
    return stream.getvalue()


def read(path: pathlib.Path, wanted: Mapping[str, Form]) -> dict[str, np.ndarray]:
    """Return the arrays of a file that are wanted; others are not read.

    Raises:
      Misfit: the file is missing or damaged, or an array is missing or has not its form.
    """
    try:
        files.require_regular(path)
        with np.load(path, allow_pickle=False) as stored:
            found = {name: stored[name] for name in wanted if name in stored.files}
    except OSError as error:
        raise typed.Misfit(error.strerror or "no file of arrays") from None
    except Exception as error:  # a damaged file can raise anything
        raise typed.Misfit(f"no file of arrays ({type(error).__name__})") from None
    sizes: dict[str, int] = {}
    for name, form in wanted.items():
        if name not in found:
            raise typed.Misfit(f"no array {name}")
        _check(name, found[name], form, sizes)
    return found


def _check(name: str, array: np.ndarray, form: Form, sizes: dict[str, int]) -> None:
    """Raise a Misfit if an array does not have its form; `sizes` holds the known lengths by name."""
    lengths = [sizes.get(want) if isinstance(want, str) else want for want in form.shape]
    fits = len(lengths) == array.ndim and all(w in (None, h) for w, h in zip(lengths, array.shape, strict=True))
    if array.dtype.kind not in form.kinds or not fits:
        has = f"{array.dtype} {list(array.shape)}"
        raise typed.Misfit(f"array {name} is {has}, want {form.kinds} {list(form.shape)} with {sizes}")
    sizes |= {want: has for want, has in zip(form.shape, array.shape, strict=True) if isinstance(want, str)}
