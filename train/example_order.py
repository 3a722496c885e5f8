"""The order in which a training sees its examples: a function of the seed and the step."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence

import numpy as np

from dipn_jax.errors import UserError

from .configs import TrainConfig, check_mix

logging.getLogger("absl").setLevel(logging.ERROR)  # Grain remarks on a profiler when it is imported
import grain  # noqa: E402


def batches(parts: Sequence[int], config: TrainConfig) -> Sequence[np.ndarray]:
    """Return the numbers of the examples of every step, an endless sequence of `[batch]`.

    Without `config.mix` every example is seen once an epoch. With it, every data set is gone through in an order of its
    own, again and again, and its examples are spread evenly over the steps.

    Args:
      parts: number of examples of each data set; they are numbered one data set after another.
      config: the batch, the seed and the mix.

    Raises:
      UserError: the mix is not one of these data sets.
    """
    check_mix(config, data_sets=len(parts))
    if config.mix and 0 in parts:
        given = " ".join(f"{weight:g}" for weight in config.mix)
        raise UserError(f"--mix {given}: --limit leaves nothing of data set {parts.index(0) + 1}; give a larger one")
    ends = list(itertools.accumulate(parts))
    begins = [0, *ends[:-1]] if config.mix else [0]
    ranges = zip(begins, ends if config.mix else ends[-1:], strict=True)
    each = [grain.MapDataset.range(begin, end).shuffle(seed=config.seed).repeat() for begin, end in ranges]
    mixed = grain.MapDataset.mix(each, weights=config.mix) if config.mix else each[0]
    found: Sequence[np.ndarray] = mixed.batch(config.batch)
    return found


def passes(size: int, config: TrainConfig) -> str:
    """Return in words how often the steps of a training see each of the `size` examples that it learns from."""
    count = config.steps * config.batch / size
    shown = f"{count:.2g}" if count < 10 else f"{count:,.0f}"
    more = "; only more --steps would see all" if count < 1 else ""
    return f"{config.steps} steps of {config.batch} examples; each of {size:,} is seen {shown} times on average{more}"
