"""The command `dipn-eval merge`: one evaluation from the parts of several workers. Imports no JAX at the top."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import tyro

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting
from dipn_jax.system import typed

from .. import options
from . import shares
from .shares import Part


def merge(parts: tyro.conf.Positional[tuple[pathlib.Path, ...]], out: pathlib.Path) -> None:
    """Put the parts of an evaluation together, with joint intervals, as if one worker had made everything.

      dipn-eval merge results/part-0 results/part-1 results/part-2 --out results/hard

    Args:
      parts: folders that dipn-eval clear, sweep, prediction or grasp wrote as parts: all of one evaluation.
      out: folder for the whole evaluation.
    """
    console.require_out(out)
    together([shares.read(folder) for folder in parts], out)


def together(parts: Sequence[Part], out: pathlib.Path) -> None:
    """Write the evaluation that the parts make.

    Raises:
      UserError: they are not all parts of one evaluation, each once; one is damaged; or somebody else has the folder.
    """
    check(parts)
    from dipn_jax.storage import owner

    with owner.owned(out):
        values = write(parts, out)
    options.show(values)


def write(parts: Sequence[Part], out: pathlib.Path) -> dict[str, Any]:
    """Write the evaluation that the parts make to a folder that this process owns, and return the metrics."""
    from .. import metrics

    made_by = accounting.makers([{**vars(part), "versions": {}} for part in parts])
    if said := accounting.describe_mixed_makers(made_by):
        console.warn(said.replace("its shards were", "parts were"))
    values = _merger(parts[0].kind)(sorted(parts, key=lambda part: part.shard), out)
    metrics.write(out, values, settings=parts[0].settings | {"out": str(out)})
    return values


def _merger(kind: str) -> Callable[[Sequence[Part], pathlib.Path], dict[str, Any]]:
    """Return the function that merges parts of a command of dipn-eval."""
    if kind == "clear":
        from ..clearing import merging as clearing

        return clearing.merge
    if kind == "grasp":
        from ..grasping import merging as grasping

        return grasping.merge
    if kind == "prediction":
        from ..prediction import merging as prediction

        return prediction.merge
    if kind == "sweep":
        from ..clearing import sweep_merging as sweeping

        return sweeping.merge
    raise UserError(f"{kind}: parts of no command that is known here; want clear, sweep, grasp or prediction")


def check(parts: Sequence[Part]) -> None:
    """Raise an error unless the parts are all of one evaluation, each once.

    Raises:
      UserError: they are not; it says which differ in what, which is there twice, or which is missing.
    """
    if not parts:
        raise UserError("merge: nothing to merge; give the folders of the parts")
    first, found = parts[0], dict[int, Part]()
    for part in parts:
        if what := _difference(first, part):
            raise UserError(f"{first.folder} and {part.folder}: {what}; give parts of one evaluation")
        if part.shard in found:
            one = found[part.shard].folder
            raise UserError(f"{one} and {part.folder}: both are shard {part.shard} of {part.of}; give each part once")
        found[part.shard] = part
    if missing := sorted(set(range(first.of)) - set(found)):
        unnamed = len(missing) - accounting.MAX_SHARDS_NAMED
        named = ", ".join(map(str, missing[: accounting.MAX_SHARDS_NAMED]))
        more = f" and {unnamed} more" if unnamed > 0 else ""
        which = f"shard{'s' if len(missing) > 1 else ''} {named}{more} of {first.of}"
        raise UserError(f"{which} missing: run {_run(first, missing[0])}")


def _difference(one: Part, other: Part) -> str:
    """Return the difference that makes two parts of different evaluations; an empty text if there is none."""
    if one.kind != other.kind:
        return f"parts of dipn-eval {one.kind} and of dipn-eval {other.kind}"
    for key in sorted({*one.named, *other.named}):
        here, there = one.named.get(key), other.named.get(key)
        if here != there:
            return f"made with {key}={_brief(here)} and {key}={_brief(there)}"
    if one.content != other.content:
        return "made with different networks or case files"
    if one.code != other.code:
        return "made by different sources or versions of packages"
    if (one.of, one.total) != (other.of, other.total):
        return f"shards of {one.of} and of {other.of} workers"
    return ""


def _brief(value: str | None) -> str:
    return "nothing" if value is None else typed.one_line(value)


def _run(part: Part, shard: int) -> str:
    """Return the command that makes another part of the evaluation, in a folder beside this one."""
    out = part.folder.with_name(f"part-{shard}-of-{part.of}")
    words = ["dipn-eval", part.kind, *part.command, "--shard", str(shard), "--of", str(part.of), "--out", str(out)]
    return accounting.quoted(words)
