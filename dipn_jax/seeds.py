"""One random key for each purpose, so that two commands with the same seed never draw the same scenes or actions."""

from __future__ import annotations

import enum

import jax
from jaxtyping import Key


class Purpose(enum.IntEnum):
    """What random numbers are for. A number is never changed and never used again, or results would change."""

    PUSH_DATA = 1  # scenes and pushes of `dipn-datagen push`
    GRASP_DATA = 2  # scenes and grasps of `dipn-datagen grasp`
    IMAGE_DATA = 3  # scenes of `dipn-datagen images`
    WORLD_CHECK = 4  # scenes and actions of `dipn-datagen check-world`
    TRAINING = 5  # views, mirroring and colours while a network learns from a data set
    ONLINE_TABLES = 6  # scenes of `dipn-train grasp-online`
    ONLINE_TRAINING = 7  # its mirroring and colours
    BASELINE_TABLES = 8  # scenes of `dipn-train baseline`
    BASELINE_TRAINING = 9  # its mirroring and colours
    PREDICTION_SCENES = 10  # scenes and pushes of `dipn-eval prediction`
    GRASP_TABLES = 11  # scenes of `dipn-eval grasp`
    RANDOM_GRASPS = 12  # the random grasps that it compares with
    SINGLE_OBJECTS = 13  # its scenes of one object, and the grasps there
    CLEARING_TABLES = 14  # scenes of `dipn-eval clear` and `sweep`
    CLEARING_CANDIDATES = 15  # the pushes considered there
    SWEEP_SCENES = 16  # scenes and pushes of the prediction errors of `dipn-eval sweep`


def key(seed: int, purpose: Purpose) -> Key[jax.Array, ""]:
    """Return the random key of a purpose at a seed; keys of different purposes are independent of one another."""
    return jax.random.fold_in(jax.random.key(seed), purpose)
