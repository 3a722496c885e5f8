"""The command `dipn-datagen merge`. Importing this imports no JAX."""

from __future__ import annotations

import tyro

from dipn_jax.errors import UserError
from dipn_jax.system import addresses
from dipn_jax.system.addresses import Place


def merge(folders: tyro.conf.Positional[tuple[Place, ...]], out: Place | None = None) -> None:
    """Join data sets of one kind: shards that workers made on several disks, or sets that were made apart.

    Shards are copied as they are. Those of one configuration keep their numbers, and what is still missing of the
    data set is said; others are numbered anew, and what differs between them is said:
      dipn-datagen merge /disk1/push /disk2/push --out data/push

    In object storage; a shard that is there is never replaced, and the list of shards is written at the end:
      dipn-datagen merge /disk1/push s3://bucket/push --out s3://bucket/joined

    Shards that were copied into a data set by hand are checked and listed:
      dipn-datagen merge data/push

    Args:
      folders: two data sets or more, or their URLs; or one folder, in which shards are to be listed.
      out: folder of the joined data set, or a URL (s3, gs, az, file); the same command continues where it stopped.
    """
    if not folders or (out is None) != (len(folders) == 1):
        raise UserError(f"merge: {len(folders)} folders {'without' if out is None else 'with'} --out; want two or more "
                        "with --out, or one without, in which copied shards are to be listed")  # fmt: skip
    from . import merging

    if out is not None:
        merging.merge(folders, out)
    elif address := addresses.url(folders[0]):
        raise UserError(f"merge {address}: shards need not be listed there; dipn-datagen verify {address} checks them")
    else:
        merging.gather(folders[0])
