"""The command `dipn-datagen replay`. Importing this imports no JAX."""

from __future__ import annotations

from typing import Annotated

import tyro

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.names import EngineName
from dipn_jax.system.addresses import Place


def replay(
    folder: tyro.conf.Positional[Place],
    ids: tyro.conf.Positional[tuple[str, ...]] = (),
    all_: Annotated[bool, tyro.conf.arg(name="all"), tyro.conf.FlagCreatePairsOff] = False,
    sample: int | None = None,
    engine: EngineName | None = None,
    timestep: float | None = None,
    tolerance: float | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> int:
    """Simulate episodes again from their records, and compare the results with what is stored; exit 1 if they differ.

    With the engine and the time step that made them, on a processor of the same kind, episodes come out as stored:
      dipn-datagen replay data/push 0 17 100:120
      dipn-datagen replay data/grasp --sample 50

    Another engine, or another kind of processor, differs in the last digits, and contact amplifies that:
      dipn-datagen replay data/push --sample 50 --engine mjx --tolerance 0.002

    Args:
      folder: a data set of pushes or grasps, or its URL.
      ids: numbers of episodes from 0, in the order of `read_episodes`; 5:8 is 5, 6, 7.
      all_: every episode.
      sample: this many episodes, drawn at random.
      engine: physics engine, that of the data set if not given.
      timestep: seconds of a physics step; that of the data set if neither this nor --engine is given.
      tolerance: largest difference that counts as none, in metres and components of quaternions; 1e-6 if not given,
        to which both are stored.
      seed: of --sample.
      threads: threads of the native engine; one per core by default.
    """
    if bool(ids) + all_ + (sample is not None) != 1:
        raise UserError("replay: give numbers of episodes, or --all, or --sample with how many")
    if sample is not None:
        console.require_positive(sample=sample)
    if tolerance is not None:
        console.require_between(0, 10, tolerance=tolerance)
    console.require_seed(seed)
    from dipn_jax.storage import mirror

    from . import replay as replaying

    data = replaying.open_set(mirror.local(folder))
    chosen = data.draw(sample, seed) if sample is not None else data.everything() if all_ else data.chosen(ids)
    return replaying.report(data, chosen, data.engine(engine, timestep, threads), tolerance)
