"""An export of a data set to files that other programs read, a part (the episodes of a shard) at a time.

What has been written stays when an export is interrupted; the same command continues with the next part.
"""

from __future__ import annotations

import importlib.util
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from dipn_jax import structs
from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import manifest, owner, records
from dipn_jax.system import files, temporary

from . import columns, rendering, steps
from .card import card
from .columns import Values
from .source import Part, Source, blocks, open_source

NEEDS = {"hdf5": ("h5py",), "zarr": ("zarr", "numcodecs")}
"""Packages of the extra `export` that a format is written with."""
WITHOUT_IMAGES = 4096
"""Episodes that are written at a time where nothing is rendered."""


class Writer(Protocol):
    """What writes a format."""

    def done(self, part: Part) -> bool:
        """Return whether a part has been written."""

    def write(self, part: Part, blocks: Iterator[Values]) -> None:
        """Write a part from the columns of its episodes, in blocks; if it is interrupted, the part is not `done`."""

    def finish(self, parts: Sequence[Part]) -> None:
        """Write what is left when all parts are written; may be called again."""


def export(data: pathlib.Path, out: pathlib.Path, *, form: str, images: str, command: Sequence[str]) -> None:
    """Export a data set.

    Args:
      data: its folder.
      out: folder of the export.
      form: parquet, npz, hdf5, zarr or lerobot.
      images: none, before, after, both or all.
      command: what the export was asked for with, for its card.

    Raises:
      UserError: the data set is missing or damaged, does not suit the format, or the folder holds something else.
    """
    console.require_out(out)
    if missing := [name for name in NEEDS.get(form, ()) if importlib.util.find_spec(name) is None]:
        raise UserError(f"--format {form}: needs {' and '.join(missing)}; run pip install 'dipn-jax[export]'")
    if (out / manifest.MANIFEST).exists():
        raise UserError(f"--out {out}: holds a data set; give another folder")
    kind = str(records.summary(data)["kind"])
    _suits(kind, form, images)
    source = open_source(data)
    with owner.owned(out):
        identity = {"export": form, "kind": kind, "images": images, "data": source.fingerprint}
        files.claim(out, identity)
        for folder in (out, *map(out.joinpath, ("data", "parts", "meta"))):
            for place in (folder, *folder.glob("chunk-*"), *folder.glob("episodes/chunk-*")):
                temporary.delete_leftovers(place)
        _write(_writer(source, out, form, images), source, images)
        files.write_text(out / "README.md", card(source, form, images, command))
    train, test = (len(source.episodes(split)) for split in ("train", "test"))
    console.say(f"{out}: {source.count} {kind} episodes as {form}, {train} to learn from and {test} held out")


def _suits(kind: str, form: str, images: str) -> None:
    """Check that a format can hold episodes of a kind, with the pictures that are asked for."""
    if form == "lerobot" and kind != "push":
        raise UserError(f"--format lerobot: holds trajectories, and {kind} episodes are single frames; give parquet")
    of_kind = {"push": ("none", "before", "after", "both", "all"), "grasp": ("none", "before", "after", "both")}
    allowed = in_tables = of_kind.get(kind, ("none", "before"))
    if form not in ("parquet", "npz"):
        allowed = steps.images_of(kind)
    if images not in allowed:
        given = " or ".join(allowed) + (", a picture of every step" if allowed != in_tables else "")
        tables = ", or --format parquet or npz" if images in in_tables else ""
        raise UserError(f"--images {images}: {kind} episodes as {form} have {given}; give one of these{tables}")


def _writer(source: Source, out: pathlib.Path, form: str, images: str) -> Writer:
    """Return the writer of a format."""
    if form in ("parquet", "npz"):
        from . import tables

        table: type[tables.Parquet] | type[tables.Npz] = tables.Parquet if form == "parquet" else tables.Npz
        return table(out, columns.of_episodes(source.kind, images), source.slots)
    if form == "lerobot":
        from . import lerobot

        return lerobot.LeRobot(out, source.slots, images)
    from . import stepped

    if form == "hdf5":
        return stepped.Hdf5(out, source.kind, images)
    return stepped.Zarr(out, source.kind, source.slots, images)


def _write(writer: Writer, source: Source, images: str) -> None:
    """Write the parts that are missing."""
    parts = source.parts()
    done = sum(part.count for part in parts if writer.done(part))
    with console.Progress("export", source.count, unit="episodes", done=done) as progress:
        for part in parts:
            if not writer.done(part):
                writer.write(part, _blocks(source, part, images, progress))
        writer.finish(parts)


def _blocks(source: Source, part: Part, images: str, progress: console.Progress) -> Iterator[Values]:
    """Return the columns of the episodes of a part, a few episodes at a time."""
    episodes, numbers, scenes = source.read(part)
    size = rendering.block(images) if images != "none" else WITHOUT_IMAGES
    for rows in blocks(part.count, size):
        some: Any = structs.take(episodes, rows)
        values = columns.values(source.kind, some, numbers[rows], scenes[rows])
        yield values | (rendering.draw(some, images) if images != "none" else {})
        progress.advance(int(np.size(numbers[rows])), part.name)
