"""Parts of an evaluation, made by several workers, each in a folder of its own. Importing this imports no JAX.

A part is what one worker measured, before anything is averaged: `part.json` says of which evaluation it is, and lists
the files beside it with their SHA-256. `merging` puts parts together.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dipn_jax.commands import console
from dipn_jax.commands.launch import Launch
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine, typed

from .. import options

if TYPE_CHECKING:
    import numpy as np

    from dipn_jax.storage import resume
    from dipn_jax.storage.arrays import Form

PART = "part.json"
"""Name of the file that makes a folder a part."""
FORMAT_VERSION = 1
"""Version of the format; parts of another version are refused."""


@dataclasses.dataclass(frozen=True)
class Share:
    """The part of an evaluation that this worker makes."""

    shard: int | None = None
    """This worker's number, from 0: it makes a part, which dipn-eval merge puts together with the others."""
    of: int = 1
    """Number of workers; each evaluates every of-th table."""

    def __post_init__(self) -> None:
        console.require_positive(of=self.of)
        if self.shard is not None and not 0 <= self.shard < self.of:
            raise UserError(f"--shard {self.shard} --of {self.of}: want 0 <= shard < of")

    @property
    def whole(self) -> bool:
        """Whether this worker makes everything, and so no part."""
        return self.shard is None

    def check(self, launch: Launch) -> None:
        """Raise a UserError for a share that does not fit the way in which the evaluation is launched."""
        if not launch.uses_cluster and self.shard is None and self.of > 1:
            raise UserError(f"--of {self.of}: give --shard, too: this worker's number, 0 to {self.of - 1}")
        if launch.uses_cluster and (self.shard is not None or self.of < 2):
            raise UserError("--launcher ray makes all shards: give --of, their number, 2 or more, and no --shard")

    def rows(self, total: int) -> range:
        """Return the numbers of what this worker evaluates, of `total` tables.

        Raises:
          UserError: there is nothing left for some of the workers.
        """
        if self.of > total:
            raise UserError(f"--of {self.of}: more workers than the {total} that can be shared; want at most {total}")
        return range(self.shard or 0, total, self.of)

    def number_and_count(self) -> tuple[int, int] | None:
        """Return number and count of the part; None where everything is made."""
        return None if self.shard is None else (self.shard, self.of)


WHOLE = Share()
"""One worker that makes everything."""


@dataclasses.dataclass(frozen=True)
class Part:
    """What `part.json` says of the part in its folder."""

    folder: pathlib.Path
    kind: str  # command of dipn-eval
    shard: int
    of: int
    total: int  # tables of the whole evaluation
    command: tuple[str, ...]  # that makes the evaluation, without --out, --shard and --of
    settings: dict[str, Any]  # as `settings.json` records them
    named: dict[str, str]  # options that the results depend on, but paths
    content: list[str]  # what the files and runs are that paths lead to
    code: str
    files: dict[str, str]  # SHA-256 by name
    about: dict[str, Any]  # what the command says of its numbers
    processor: str
    instructions: str

    def rows(self) -> range:
        """Return the numbers of the tables of this part."""
        return range(self.shard, self.total, self.of)

    def path(self, name: str) -> pathlib.Path:
        """Return the path of a file of the part, which is whole.

        Raises:
          UserError: it is missing or damaged, or not listed.
        """
        if name not in self.files:
            raise UserError(f"{self.folder / PART}: lists no {name}; {self.advice()}")
        path = typed.inside(self.folder, name)
        if not path.is_file() or files.file_sha256(path) != self.files[name]:
            raise UserError(f"{path}: missing, or damaged since it was written; {self.advice()}")
        return path

    def advice(self) -> str:
        """Return in words what to do about a part that cannot be used."""
        return f"delete {self.folder / PART} and run its command again"


_FORM = {
    "format": typed.Whole(),
    "kind": str,
    "shard": typed.Whole(),
    "of": typed.Whole(1),
    "total": typed.Whole(1),
    "command": [str],
    "settings": dict,
    "named": {str: str},
    "content": [str],
    "code": str,
    "files": {str: str},
    "about": dict,
    "processor": str,
    "instructions": str,
}
"""Form of `part.json`."""


def read(folder: pathlib.Path) -> Part:
    """Return the part in a folder.

    Raises:
      UserError: there is none, or it is damaged or of another version.
    """
    path = folder / PART
    if not path.exists():
        raise UserError(f"{folder}: no part of an evaluation; give folders that dipn-eval wrote with --shard and --of")
    found = files.read_json(path, wanted=_FORM)
    if found["format"] != FORMAT_VERSION:
        raise UserError(f"{path}: format {found['format']}, want {FORMAT_VERSION}; make the part again")
    if not found["shard"] < found["of"] <= found["total"]:
        raise UserError(f"{path}: damaged, shard {found['shard']} of {found['of']}; make the part again")
    try:
        for name in found["files"]:
            typed.inside(folder, name)
    except typed.Misfit as error:
        raise UserError(f"{path}: damaged, {error}; make the part again") from None
    names = {field.name for field in dataclasses.fields(Part)} - {"folder"}
    return Part(folder, **{name: found[name] for name in names} | {"command": tuple(found["command"])})


def pooled(parts: Sequence[Part], name: str, forms: Mapping[str, Form], *, by: str) -> dict[str, np.ndarray]:
    """Return the arrays that all parts hold in their files `name`, joined along the first axis and sorted.

    Args:
      parts: all of an evaluation.
      name: of the files.
      forms: of the arrays.
      by: name of the array of numbers that they are sorted by.

    Raises:
      UserError: a part is damaged.
    """
    import numpy as np

    from dipn_jax.storage import arrays

    found = []
    for part in parts:
        try:
            found.append(arrays.read(part.path(name), forms))
        except typed.Misfit as error:
            raise UserError(f"{part.folder / name}: damaged, {error}; {part.advice()}") from None
    places = np.argsort(np.concatenate([each[by] for each in found]), kind="stable")
    return {key: np.concatenate([each[key] for each in found])[places] for key in forms}


def is_made(out: pathlib.Path, kind: str, share: Share, partial: resume.Partial, *, quiet: bool = False) -> bool:
    """Return whether the part of this worker is in its folder already, whole; a line says so, if not `quiet`.

    Raises:
      UserError: another part is there.
    """
    if share.whole or not (out / PART).exists():
        return False
    there = read(out)
    mine = (kind, share.shard, share.of, partial.named, partial.content, partial.code)
    if mine != (there.kind, there.shard, there.of, there.named, there.content, there.code):
        raise UserError(f"{out}: holds another part of an evaluation; give another --out")
    for name in there.files:
        there.path(name)
    if not quiet:
        console.say(f"{out}: shard {there.shard} of {there.of} is there already")
    return True


def write(
    out: pathlib.Path,
    kind: str,
    share: Share,
    *,
    total: int,
    command: Sequence[str],
    given: dict[str, Any],
    partial: resume.Partial,
    names: Sequence[str],
    about: Mapping[str, Any],
) -> None:
    """Write `part.json`, after everything else of the part, and delete what was kept in case of an interruption.

    Args:
      out: folder of the part.
      kind: command of dipn-eval.
      share: which part it is.
      total: tables of the whole evaluation.
      command: that makes the evaluation, without --out, --shard and --of.
      given: options, for `settings.json`.
      partial: of this part.
      names: files that were written beside it.
      about: what merging has to know, besides the files; it has to fit into JSON.
    """
    settings = options.recorded(given, partial)
    files.write_json(
        out / PART,
        {
            "format": FORMAT_VERSION,
            "kind": kind,
            "shard": share.shard,
            "of": share.of,
            "total": total,
            "command": list(command),
            "settings": settings,
            "named": partial.named,
            "content": partial.content,
            "code": partial.code,
            "files": {name: files.file_sha256(out / name) for name in names},
            "about": dict(about),
            "processor": machine.processor(),
            "instructions": machine.instructions(),
        },
    )
    partial.finish()
    console.say(f"{out}: shard {share.shard} of {share.of}, {len(share.rows(total))} of {total}")
