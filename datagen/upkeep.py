"""The commands that look after a data set: verify, repair and info."""

from __future__ import annotations

import json
import pathlib

import tyro

from dipn_jax.commands import console, option_paths
from dipn_jax.errors import UserError
from dipn_jax.system import addresses
from dipn_jax.system.addresses import Place

MAX_PAGE_EPISODES = 2000
"""Episodes on a page at most: about 10 MB."""


def verify(folder: tyro.conf.Positional[Place]) -> None:
    """Check every shard, and that all episodes that were asked for are there; exit 2 if something is wrong.

    Sizes, SHA-256 and columns of the shards are held against the manifest; a shard that no worker has made is named,
    with the command that makes it. A line says where versions or kinds of processor that made shards differ.

    Args:
      folder: a data set, or its URL.
    """
    from dipn_jax.storage import mirror, records

    folder = mirror.local(folder)
    problems, mixed = records.verify_with_makers(folder)
    if mixed:
        console.warn(mixed)
    if problems:
        path, what = problems[0]
        raise UserError(
            f"{path}: {what} ({len(problems)} shards wrong in all); run dipn-datagen repair {folder}, then generate "
            "again"
        )
    if said := records.missing(folder):
        raise UserError(said)
    console.say(f"{folder}: all shards are whole")


def repair(folder: tyro.conf.Positional[Place]) -> None:
    """Set damaged shards aside and rebuild the manifest; the command that made the data set then fills the gaps.

    Args:
      folder: a data set, or its URL.
    """
    from dipn_jax.storage import mirror, places, records

    address = addresses.url(folder)
    removed = places.repair(address) if address else records.repair(folder)
    folder, names = mirror.local(folder), ", ".join(path.name for path in removed)
    console.say(f"{folder}: {len(removed)} damaged shards set aside{names and f': {names}'}")
    console.say(records.missing(folder) or f"{folder}: nothing is missing")


def info(
    folder: tyro.conf.Positional[Place],
    html: pathlib.Path | None = None,
    sample: int = 100,
    seed: int = 0,
) -> None:
    """Print what a data set holds, as JSON: episodes, bytes, config, faults counted, and who made it.

    `made_by` lists every combination of versions and kind of processor. On standard error, a line says where they
    differ, and one what is missing of the episodes that were asked for.

    One page for a browser, with counts of what was drawn, and pictures to be sifted by fault, shape and outcome:
      dipn-datagen info data/push --html push.html --sample 200

    Args:
      folder: a data set, or its URL.
      html: file of the page, NAME.html, which needs no other.
      sample: episodes on the page, drawn at random.
      seed: of that draw.
    """
    from dipn_jax.storage import accounting, mirror, records

    console.require_between(1, MAX_PAGE_EPISODES, sample=sample)
    console.require_seed(seed)
    if html is not None:
        option_paths.require_file(html, ".html", ".htm", option="html")
    folder = mirror.local(folder)
    summary = records.summary(folder)
    if html is not None:
        from . import browsing

        browsing.write(folder, html, sample=sample, seed=seed)
    console.say(json.dumps(summary, indent=1))
    mixed = accounting.describe_mixed_makers(summary["made_by"])
    for said in (mixed and f"{folder}: {mixed}", summary["missing"]):
        if said:
            console.warn(said)
