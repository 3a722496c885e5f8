"""Files that are not what they should be: mutations of valid JSON, Parquet and arrays, drawn by a random generator.

The experiment `fuzz` draws from `random.Random`; tests give the same functions a generator of Hypothesis.
"""

from __future__ import annotations

import copy
import io
import json
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

Mutate = Callable[[random.Random, bytes], bytes]
"""What turns a valid file into one that is perhaps none."""
NUMBERS: tuple[Any, ...] = (
    0, 1, -1, 2, 3, 7, 255, 2**31 - 1, 2**31, -(2**31), 2**63 - 1, 2**63, -(2**63), 2**64, 10**30, 10**400,
    0.5, -0.0, 1e-320, 1e-30, 1e30, 1e300, -1e300, float("nan"), float("inf"), float("-inf"), 1.0, 3.0000001,
)  # fmt: skip
"""Numbers that are small, huge, negative, or none."""
TEXTS = (
    "", "0", "push", "images", "nan", "../x", "/etc/passwd", "a/../../b", "shard-00000.parquet", "shard-99999.parquet",
    "\0", "\ud800", "\n", "é", "\u202e", "x" * 5000, "int32", "float16", "object", "..", "{}", "%s", "C:\\x", "~",
)  # fmt: skip
"""Texts that are names, paths, or hard to write."""


def any_value(draw: random.Random, *, depth: int = 3) -> Any:
    """Return a JSON value of any type."""
    kind = draw.randrange(8 if depth else 6)
    if kind == 7:
        return {draw.choice(TEXTS): any_value(draw, depth=depth - 1) for _ in range(draw.randrange(4))}
    if kind == 6:
        return [any_value(draw, depth=depth - 1) for _ in range(draw.randrange(4))]
    return (None, True, False, draw.choice(NUMBERS), draw.choice(NUMBERS), draw.choice(TEXTS))[kind]


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Return every place in a JSON value: what it is in, and its key or index."""
    found: list[tuple[Any, Any]] = []
    if isinstance(tree, dict):
        found += [(tree, key) for key in tree]
    elif isinstance(tree, list):
        found += [(tree, index) for index in range(len(tree))]
    return found + [place for inner, key in list(found) for place in _places(inner[key])]


def mutate_tree(draw: random.Random, tree: Any) -> Any:
    """Return a JSON value with one to three entries dropped, renamed, doubled, nested, or of another type or size."""
    tree = copy.deepcopy(tree)
    for _ in range(draw.randrange(1, 4)):
        places = _places(tree)
        if not places or draw.random() < 0.02:
            return any_value(draw)
        holder, key = draw.choice(places)
        change = draw.randrange(8)
        value = holder[key]
        if change == 0:
            del holder[key]
        elif change == 1 and isinstance(holder, dict):
            holder[draw.choice((*TEXTS, *holder))] = holder.pop(key)
        elif change == 2 and isinstance(holder, list):
            holder.insert(draw.randrange(len(holder) + 1), copy.deepcopy(value))
        elif change == 3:
            other, its = draw.choice(places)
            holder[key] = copy.deepcopy(other[its])
        elif change == 4:
            holder[key] = draw.choice(([value], {"a": value}, str(value), [value, value], [], {}))
        elif change == 5 and type(value) in (int, float):
            holder[key] = draw.choice((-value, value + 1, value - 1, value * 2, value // 3, value * 10**6, *NUMBERS))
        else:
            holder[key] = any_value(draw)
    return tree


def mutate_bytes(draw: random.Random, data: bytes) -> bytes:
    """Return bytes that are cut, longer, or have some of them flipped, lost, doubled or zero."""
    changed = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 8))):
        at = draw.randrange(len(changed) + 1)
        to = min(len(changed), at + draw.choice((1, 1, 4, 64)))
        change = draw.randrange(7)
        if change == 0:
            del changed[at:]
        elif change == 1:
            del changed[at:to]
        elif change == 2:
            changed[at:at] = changed[at:to]
        elif change == 3:
            changed[at:to] = bytes(to - at)
        elif change == 4:
            changed[at:at] = bytes(draw.randrange(256) for _ in range(draw.randrange(8)))
        else:
            for place in range(at, to):
                changed[place] ^= 1 << draw.randrange(8)
    return bytes(changed)


def mutate_json(draw: random.Random, data: bytes) -> bytes:
    """Return the bytes of a JSON file that is perhaps none: another tree, encoding or bytes, or deep nesting."""
    way = draw.random()
    if way < 0.15:
        return mutate_bytes(draw, data)
    if way < 0.2:
        open_, close = draw.choice((("[", "]"), ('{"a":', "}"), ('{"cases":[', "]}")))
        depth = draw.choice((3, 100, 20_000))
        return (open_ * depth + draw.choice(("1", "", "{}")) + close * draw.choice((depth, 0))).encode()
    text = json.dumps(mutate_tree(draw, json.loads(data)), ensure_ascii=draw.random() < 0.5)
    encoding = draw.choice(("utf-8", "utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "utf-32", "latin-1"))
    return text.encode(encoding, "surrogatepass" if encoding != "latin-1" else "replace")


def mutate_lines(draw: random.Random, data: bytes) -> bytes:
    """Return a file of lines of JSON with some of them mutated."""
    lines = data.splitlines()
    return b"\n".join(mutate_json(draw, line) if draw.random() < 0.5 else line for line in lines) + b"\n"


def with_meta(data: bytes, meta: Any) -> bytes:
    """Return a shard with other metadata: what fits into JSON, or bytes."""
    text = meta if isinstance(meta, bytes) else json.dumps(meta).encode()
    return _parquet(pq.read_table(io.BytesIO(data)).replace_schema_metadata({b"dipn_jax": text}))


def meta_of(data: bytes) -> Any:
    """Return the metadata of a shard."""
    return json.loads(pq.read_schema(io.BytesIO(data)).metadata[b"dipn_jax"])


def _parquet(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


_TYPES = (
    pa.int8(), pa.int64(), pa.float32(), pa.float64(), pa.string(), pa.bool_(), pa.binary(), pa.list_(pa.int32()),
    pa.list_(pa.int64(), 3), pa.list_(pa.float32(), 1), pa.list_(pa.int32(), 7), pa.list_(pa.string(), 1),
)  # fmt: skip


def mutate_columns(draw: random.Random, table: pa.Table) -> pa.Table:
    """Return a table with a column dropped, renamed, doubled, retyped, with empty places, or with other rows."""
    at = draw.randrange(table.num_columns)
    name, change = table.column_names[at], draw.randrange(8)
    if change == 0:
        return table.drop_columns([name])
    if change == 1:
        names = [
            draw.choice((*TEXTS[2:5], *table.column_names)) if i == at else n for i, n in enumerate(table.column_names)
        ]
        return table.rename_columns(names)
    if change == 2:
        return table.append_column(name, table.column(at))
    if change == 3:
        return table.slice(0, draw.randrange(table.num_rows + 1))
    if change == 4:
        return pa.concat_tables([table, table])
    if change == 5:
        rows = table.column(at).to_pylist()
        rows[draw.randrange(len(rows))] = None
        return table.set_column(at, name, pa.array(rows, table.schema.field(at).type))
    if change == 6:
        other = draw.randrange(table.num_columns)
        return table.set_column(at, name, table.column(other))
    return table.set_column(at, name, pa.nulls(table.num_rows, draw.choice(_TYPES)))


def mutate_parquet(draw: random.Random, data: bytes) -> bytes:
    """Return a shard that is perhaps none: other columns, other metadata, or other bytes."""
    way = draw.random()
    if way < 0.35:
        return mutate_bytes(draw, data)
    if way < 0.7:
        meta = mutate_tree(draw, meta_of(data))
        if isinstance(meta, dict) and draw.random() < 0.5:  # where it says who may read it, and little else is wrong
            meta["schema_version"] = meta_of(data)["schema_version"]
        text = json.dumps(meta).encode()
        return with_meta(data, mutate_bytes(draw, text) if draw.random() < 0.1 else text)
    table = mutate_columns(draw, pq.read_table(io.BytesIO(data)))
    return _parquet(table)


def mutate_arrays(draw: random.Random, data: bytes) -> bytes:
    """Return a file of arrays with some dropped, renamed, or of another type, shape or content; or other bytes."""
    if draw.random() < 0.3:
        return mutate_bytes(draw, data)
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        found = {name: stored[name] for name in stored.files}
    for _ in range(draw.randrange(1, 3)):
        name = draw.choice(sorted(found))
        array, change = found[name], draw.randrange(8)
        if change == 0 and len(found) > 1:
            del found[name]
        elif change == 1:
            found[draw.choice(("other", *found))] = found.pop(name)
        elif change == 2:
            found[name] = np.zeros(array.shape, draw.choice(("U4", "S3", "?", "f2", "i1", "c8")))
        elif change == 3:
            found[name] = array[..., None]
        elif change == 4:
            found[name] = array[: draw.randrange(len(array) + 1)] if array.ndim else array.reshape(1)
        elif change == 5:
            found[name] = np.zeros(draw.choice(((), (0,), (1, 1), (2, 3, 4))), draw.choice(("f4", "i8", "U1", "?")))
        elif name == "value":  # the form in JSON of a state
            found[name] = np.frombuffer(mutate_json(draw, array.tobytes()), np.uint8)
        elif array.dtype.kind in "fiu" and array.size:
            flat = array.reshape(-1).copy()
            flat[draw.randrange(flat.size)] = draw.choice((0, 1, 100))
            found[name] = flat.reshape(array.shape)
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **found)
    return stream.getvalue()
