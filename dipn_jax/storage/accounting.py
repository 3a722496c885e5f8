"""Which episodes of a data set were asked for, which exist, and who made them.

`asked.json` beside the shards keeps the command that makes them, so that a gap can be named with what fills it.
"""

from __future__ import annotations

import collections
import dataclasses
import pathlib
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from dipn_jax.system import files, typed

REQUEST_FILE = "asked.json"
"""Name of the file with the command that makes a data set."""
MAX_SHARDS_NAMED = 8
"""Shards that a message names at most."""
MAX_COMMAND_CHARS = 4000
"""Characters of a command that a message shows at most."""
NOT_RECORDED = "not recorded"
"""What stands for the kind of processor of a shard that does not say it."""


@dataclasses.dataclass(frozen=True)
class RequestedSize:
    """Requested size of a data set; the last shard may be shorter."""

    episodes: int
    shard_size: int

    def shards(self) -> int:
        """Return the number of shards."""
        return -(-self.episodes // self.shard_size)

    def size(self, index: int) -> int:
        """Return the number of episodes of shard `index`."""
        return min(self.shard_size, self.episodes - index * self.shard_size)


def save_command(folder: pathlib.Path, command: Sequence[str], *, of: int) -> None:
    """Keep the command that makes a data set, without `--out`, `--shard` and `--of`, and the number of workers."""
    files.write_json(folder / REQUEST_FILE, {"command": list(command), "of": of})


def command(folder: pathlib.Path) -> list[str] | None:
    """Return the words of the command that makes a data set, without its folder; None where they are not kept.

    Raises:
      UserError: the file that keeps them is damaged.
    """
    path = folder / REQUEST_FILE
    if not path.exists():
        return None
    return ["dipn-datagen", *files.read_json(path, wanted={"command": [str]})["command"]]


def requested_size(folder: pathlib.Path) -> RequestedSize | None:
    """Return the requested size of a data set; None where its folder does not say it.

    Raises:
      UserError: its configuration is damaged.
    """
    path = folder / "config.json"
    if not path.exists():
        return None
    if merged(folder) is not None:
        return None
    found = files.read_json(path, wanted={"episodes": typed.Whole(1), "shard_size": typed.Whole(1)})
    return RequestedSize(found["episodes"], found["shard_size"])


def merged(folder: pathlib.Path) -> list[dict[str, Any]] | None:
    """Return what was joined to a merged data set: of each part its `config` and the number of its `episodes`.

    None for a data set that was made by one command.

    Raises:
      UserError: its configuration is damaged.
    """
    path = folder / "config.json"
    if not path.exists():
        return None
    parts = [{"config": dict, "episodes": typed.Whole(1)}]
    found: dict[str, Any] = files.read_json(path, wanted={"merged?": parts})
    return found.get("merged")


def episodes_by_shard(entries: Mapping[str, Any]) -> dict[int, int]:
    """Return the number of episodes in each shard that a manifest lists, by the shard's number."""
    named = ((re.fullmatch(r"shard-(\d{1,18})\.parquet", name), entry) for name, entry in entries.items())
    numbers = [(int(name[1]) if name else -1 - at, entry["episodes"]) for at, (name, entry) in enumerate(named)]
    return dict(numbers)


def missing(folder: pathlib.Path, held: Mapping[int, int]) -> str | None:
    """Say in one line which episodes that were asked for are not there, and the command that makes them.

    Args:
      folder: the data set.
      held: number of episodes in each of its shards.

    Returns:
      None where nothing is missing, or nothing is known of what was asked for.

    Raises:
      UserError: the configuration of the data set, or the command that is kept, is damaged.
    """
    want = requested_size(folder)
    if want is None:
        return None
    # a configuration can ask for more shards than can be listed: those that are there are fewer
    of_these = {index: min(has, want.size(index)) for index, has in held.items() if 0 <= index < want.shards()}
    there = {index for index, has in of_these.items() if has == want.size(index)}
    number = want.shards() - len(there)
    if number <= 0:
        return None
    gaps = [index for index in range(min(want.shards(), len(there) + MAX_SHARDS_NAMED + 1)) if index not in there]
    named = ", ".join(str(index) for index in gaps[:MAX_SHARDS_NAMED])
    more = f" and {number - MAX_SHARDS_NAMED} more" if number > MAX_SHARDS_NAMED else ""
    return (
        f"{folder}: {sum(of_these.values())} of {want.episodes} episodes, shard{'s' if number > 1 else ''} "
        f"{named}{more} missing: run {_command(folder, gaps, every=number <= MAX_SHARDS_NAMED)}"
    )


def _command(folder: pathlib.Path, gaps: Sequence[int], *, every: bool) -> str:
    """Return the command that makes the missing shards: of the one worker that they belong to, or without a worker."""
    path = folder / REQUEST_FILE
    if not path.exists():
        return "the command that made it again"
    found = files.read_json(path, wanted={"command": [str], "of": typed.Whole(1)})
    command = ["dipn-datagen", *found["command"], "--out", str(folder)]
    workers = {index % found["of"] for index in gaps}
    if found["of"] > 1 and len(workers) == 1 and every:
        command += ["--shard", str(min(workers)), "--of", str(found["of"])]
    return quoted(command)


def quoted(words: Sequence[str]) -> str:
    """Return a command on one line, as a shell reads it, in backticks."""
    return f"`{typed.one_line(shlex.join(words), most=MAX_COMMAND_CHARS)}`"


def makers(metas: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return every combination of versions and kind of processor that made shards, with how many each made.

    Args:
      metas: metadata of the shards, as `shards.read_meta` returns them.
    """
    counts: collections.Counter[tuple[Any, ...]] = collections.Counter()
    for meta in metas:
        kind = (meta.get("processor", NOT_RECORDED), meta.get("instructions", NOT_RECORDED))
        counts[tuple(sorted(meta["versions"].items())), *kind] += 1
    return [
        {"processor": processor, "instructions": instructions, "versions": dict(versions), "shards": number}
        for (versions, processor, instructions), number in counts.most_common()
    ]


def describe_mixed_makers(made_by: Sequence[Mapping[str, Any]]) -> str | None:
    """Say in one line what differs between those who made a data set; None where nothing does.

    Args:
      made_by: as from `makers`.
    """
    facts = [{f"{one['processor']} ({one['instructions']})" for one in made_by}]
    packages = sorted({name for one in made_by for name in one["versions"]})
    facts += [{f"{name} {one['versions'].get(name, NOT_RECORDED)}" for one in made_by} for name in packages]
    differ = [" and ".join(sorted(each)) for each in facts if len(each) > 1]
    if not differ:
        return None
    return f"its shards were made by different versions or kinds of processor: {'; '.join(differ)}"
