"""The columns of each kind of episode, and a check that a shard has exactly these.

They follow from the annotations of the structs: `Float[Array, "*b N 3"]` is a column of numbers, 3 for each of N slots.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from typing import Any

import numpy as np
import pyarrow as pa

from dipn_jax import structs
from dipn_jax.storage import codec
from dipn_jax.system import typed

KINDS: dict[str, type] = {
    "push": structs.PushEpisode,
    "grasp": structs.GraspEpisode,
    "images": structs.SettledScene,
}
"""Kinds of data sets, and the struct of their episodes."""
META = {
    "kind": set(KINDS),
    "shard": typed.Whole(),
    "columns": {
        str: {
            "dtype": {"int8", "int16", "int32", "int64", "bool", "float32", "float64"},
            "shape": [typed.Whole(1, 2**20)],
            "quantum?": float,
            "code?": {"value", "delta", "from poses"},
        }
    },
    "config": dict,
    "faults": {str: typed.Whole()},
    "versions": {str: str},
    "processor?": str,
    "instructions?": str,
    "start?": str,
}
"""Form of the metadata of a shard."""


@dataclasses.dataclass(frozen=True)
class Column:
    """What a column has to hold."""

    kind: str  # of NumPy: f, i or b
    shape: tuple[str, ...]  # of an episode: lengths, or the name of one


@functools.cache
def columns(struct: type) -> dict[str, Column]:
    """Return the columns of a struct of episodes by dotted name, from its annotations."""
    found: dict[str, Column] = {}
    for name, hint in typing.get_type_hints(struct).items():
        if dataclasses.is_dataclass(hint):
            found |= {f"{name}.{inner}": column for inner, column in columns(typing.cast(type, hint)).items()}
            continue
        array = next(one for one in typing.get_args(hint) if hasattr(one, "dim_str"))
        kind = "b" if "bool" in str(array.dtypes) else "f" if "float32" in array.dtypes else "i"
        found[name] = Column(kind, tuple(array.dim_str.split()[1:]))
    return found


def problem(meta: dict[str, Any], schema: pa.Schema) -> str:
    """Return what is wrong with the columns of a shard; an empty text if nothing is.

    Args:
      meta: its metadata, of the form META.
      schema: of the file.
    """
    wanted, sizes = columns(KINDS[meta["kind"]]), dict[str, int]()
    for name, column in wanted.items():
        spec = meta["columns"].get(name)
        if spec is None:
            return f"its metadata has no column {name}"
        if schema.names.count(name) != 1:
            return f"it has {'no' if name not in schema.names else 'more than one'} column {name}"
        said = _kind_problem(name, column, spec) or _shape_problem(name, column, spec, sizes)
        if said:
            return said
        arrow = pa.list_(pa.from_numpy_dtype(np.dtype(spec["dtype"])), math.prod(spec["shape"]))
        if schema.field(name).type != arrow:
            return f"its column {name} is of type {typed.brief(str(schema.field(name).type))}, want {arrow}"
    if others := sorted(set(meta["columns"]) - set(wanted)):
        return f"its metadata has a column {typed.brief(others[0])}, which {meta['kind']} episodes have not"
    return ""


def _kind_problem(name: str, column: Column, spec: dict[str, Any]) -> str:
    """Return what is wrong with the type of a column, and with how it is coded."""
    quantum, code = spec.get("quantum"), spec.get("code")
    if name in codec.QUANTA:
        codes = {"poses": ("value", "delta"), "after": ("value", "from poses")}.get(name, ("value",))
        if quantum is None or not 0 < quantum <= 1 or code not in codes or spec["dtype"] != "int32":
            has = f"{spec['dtype']} with quantum {quantum} and code {code}"
            return f"its column {name} is {has}, want int32 with a quantum from 0 to 1 and code {' or '.join(codes)}"
        if code == "delta" and len(column.shape) != 3:
            return f"its column {name} has code delta, which these episodes have not"
    elif quantum is not None or code is not None or np.dtype(spec["dtype"]).kind != column.kind:
        wanted = {"f": "float", "i": "int", "b": "bool"}[column.kind]
        return f"its column {name} is {spec['dtype']}{' with a quantum' if quantum or code else ''}, want {wanted}"
    return ""


def _shape_problem(name: str, column: Column, spec: dict[str, Any], sizes: dict[str, int]) -> str:
    """Return what is wrong with the shape of a column; `sizes` holds the known lengths by name."""
    shape = spec["shape"]
    lengths = [int(want) if want.isdecimal() else sizes.get(want) for want in column.shape]
    if len(shape) != len(lengths) or any(want not in (None, has) for want, has in zip(lengths, shape, strict=True)):
        return f"its column {name} has shape {typed.brief(str(shape))}, want {' '.join(column.shape)} with {sizes}"
    sizes |= {want: has for want, has in zip(column.shape, shape, strict=True) if not want.isdecimal()}
    return ""
