"""Episodes as columns of whole multiples of a quantum, so that a file holds what could be measured and no noise.

Poses after an action are stored as changes from the last ones before: most objects do not move any more, and zeros take
no room. The poses of a push are stored as they are: what stands still repeats itself, which compresses better than
changes from centimetre to centimetre. A decoded value is within half a quantum.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
import numpy as np

from dipn_jax import structs

T = TypeVar("T")

QUANTA = {
    "poses": 1e-6,  # metres, and components of quaternions
    "after": 1e-6,
    "scene.size": 1e-6,
    "scene.mass": 1e-6,  # kg
    "scene.friction": 1e-5,
    "scene.color": 1 / 2550,  # tenths of an 8-bit step
    "push.start": 1e-6,
    "push.angle": 1e-6,  # radians
    "push.distance": 1e-6,
    "grasp.center": 1e-6,
    "grasp.angle": 1e-6,
    "grasp.height": 1e-6,
}
"""Quanta of the columns that are quantized."""
Columns = dict[str, np.ndarray]
"""Columns of a data set by their name."""


def columns(episodes: Any) -> Columns:
    """Return the leaves of a struct of episodes as columns `[B, ...]`, by dotted name."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(episodes)
    return {jax.tree_util.keystr(path).lstrip("."): np.asarray(leaf) for path, leaf in leaves}


def assemble(struct: type, columns: Columns, *, prefix: str = "") -> Any:
    """Return the struct of episodes whose leaves are `columns`; names of structs inside it begin with `prefix`."""
    nested = {"scene": structs.Scene, "push": structs.Push, "grasp": structs.Grasp}
    values = {}
    for field in dataclasses.fields(struct):
        name = prefix + field.name
        inner = nested.get(field.name)
        values[field.name] = assemble(inner, columns, prefix=f"{name}.") if inner else columns[name]
    return struct(**values)


def encode(columns: Columns) -> tuple[Columns, dict[str, dict[str, Any]]]:
    """Return columns `[B, ...]` as they are stored, and how to decode them.

    Args:
      columns: as from `columns`.

    Returns:
      Columns of the same names and shapes, quantized ones as int32; and for each of those the keys `quantum` and
      `code`: `value`, or `from poses` (differences from the last of `poses`).

    Raises:
      ValueError: a value to quantize is not finite, or too large.
    """
    stored, specs = dict(columns), {}
    for name, quantum in QUANTA.items():
        if name not in columns:
            continue
        if not np.isfinite(columns[name]).all():
            raise ValueError(f"column {name}: not finite")
        stored[name] = np.rint(columns[name].astype(np.float64) / quantum).astype(np.int64)
        if np.abs(stored[name]).max(initial=0) >= 2**30:
            raise ValueError(
                f"column {name}: {np.abs(columns[name]).max():g} is too large for a quantum of {quantum:g}"
            )
        specs[name] = {"quantum": quantum, "code": "value"}
    if "after" in stored and "poses" in stored:
        stored["after"] = stored["after"] - _last(stored["poses"], stored["after"])
        specs["after"]["code"] = "from poses"
    return {k: v.astype(np.int32) if k in specs else v for k, v in stored.items()}, specs


def _last(poses: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the last poses before the action, in the shape of those after it."""
    return poses[:, -1] if poses.ndim > after.ndim else poses


def decode(stored: Columns, specs: dict[str, dict[str, Any]], *, into: Columns | None = None) -> Columns:
    """Return the inverse of `encode`; quantized columns become float32.

    It also knows the code `delta` of shards of version 2: differences along the second axis.

    Args:
      stored: columns as `encode` returns them.
      specs: how to decode them.
      into: arrays that the columns are written to, of the same shapes; new ones if not given.
    """
    columns = dict(stored)
    if specs.get("poses", {}).get("code") == "delta":
        columns["poses"] = np.cumsum(columns["poses"], axis=1, dtype=np.int64)
    if specs.get("after", {}).get("code") == "from poses":
        columns["after"] = columns["after"].astype(np.int64) + _last(columns["poses"], columns["after"])
    for name, spec in specs.items():
        decoded = into[name] if into else np.empty(columns[name].shape, np.float32)
        # in double precision, a few numbers at a time
        columns[name] = np.multiply(columns[name], spec["quantum"], out=decoded, dtype=np.float64, casting="same_kind")
    for name in (into or {}).keys() - specs.keys():
        into[name][:] = columns[name]  # type: ignore[index]
    return columns


def rounded(struct: T, *, prefix: str = "") -> T:
    """Return a batch rounded as a shard stores it.

    What is simulated from rounded values can be simulated again from what is stored, bit for bit.

    Args:
      struct: a batch of scenes, poses or actions, NumPy or JAX.
      prefix: before the names of its columns, such as `push.` for a `Push`.
    """
    named = {prefix + name: value for name, value in columns(struct).items()}
    return assemble(type(struct), decode(*encode(named)), prefix=prefix)


STEPS = {name: np.float32(round(1 / quantum)) for name, quantum in QUANTA.items()}
"""Quanta in a unit (a metre, a kilogram, ...) for each quantized column, which are whole numbers."""


def rounded_on_device(struct: T, steps: dict[str, jax.Array], *, prefix: str = "") -> T:
    """Return a batch rounded as `rounded` does, traced.

    A value near the middle between two multiples of a quantum may become the other one: the product is a float32.

    Args:
      struct: a batch of scenes, poses or actions, JAX.
      steps: STEPS, as an argument of the compiled function: XLA multiplies by the inverse of a constant divisor, which
        is rounded, so that what is stored would not be what was simulated.
      prefix: before the names of its columns, such as `push.` for a `Push`.
    """

    def one(path: Any, leaf: jax.Array) -> jax.Array:
        each = steps.get(prefix + jax.tree_util.keystr(path).lstrip("."))
        return leaf if each is None else jax.numpy.round(leaf * each) / each

    return jax.tree_util.tree_map_with_path(one, struct)
