"""The tables to clear: hand-placed cases with perturbed physics, and random clutter."""

from __future__ import annotations

import dataclasses
import pathlib
import zlib

import numpy as np
from jaxtyping import Float

from dipn_jax import seeds, structs
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.planning.memory import MissedGrasps
from dipn_jax.storage import serialization
from dipn_jax.structs import Fault, Scene
from dipn_jax.world import cases as case_files
from dipn_jax.world import clutter, primitives, scenes

JITTER = 0.002
"""Largest distance in metres by which an object of a repeated case is moved."""
MASS_FACTOR = (0.8, 1.2)
"""Range of the factor on the mass of each object of a repeated case."""
FRICTION_FACTOR = (0.85, 1.15)
"""Range of the factor on the friction of each object of a repeated case."""


@serialization.register
@dataclasses.dataclass
class Instance:
    """One table being cleared."""

    name: str
    scene: Scene  # numpy, [N]
    poses: Float[np.ndarray, "N 7"]
    objects: int  # on the table at the beginning
    number: int = 0  # of its random keys; it does not depend on the other tables
    grasps: int = 0  # made so far, held or missed
    pushes: int = 0  # made so far
    removed: int = 0  # objects taken away by grasps so far
    held: int = 0  # grasps that held something
    ended: str = ""  # cleared, pushed out, out of actions, fault
    did: list[str] = dataclasses.field(default_factory=list)  # push, grasp held or grasp missed, one an action
    missed: MissedGrasps = dataclasses.field(default_factory=MissedGrasps)  # and the table looks as then
    film: list[dict[str, np.ndarray]] = dataclasses.field(default_factory=list)  # poses and decision before each action

    @property
    def actions(self) -> int:
        return self.grasps + self.pushes


def case_instances(
    engine: Engine,
    path: pathlib.Path,
    names: list[str] | None,
    *,
    slots: int,
    repeats: int,
    seed: int,
    perturbed: bool = True,
) -> list[Instance]:
    """Return the settled cases of a file, `repeats` of each, all slightly different.

    Their objects are moved by up to JITTER, their masses and frictions multiplied by random factors. A repeat of a case
    does not depend on how many others there are. Not `perturbed`, they are taken as they are placed.

    Raises:
      UserError: a name is not in the file.
    """
    found, scene, poses = case_files.load_cases(path, slots=slots)
    wanted = names or found
    missing = [name for name in wanted if name not in found]
    if missing:
        raise UserError(f"--names {' '.join(missing)}: not in {path}; it has {', '.join(found)}")
    index = np.array([found.index(name) for name in wanted for _ in range(repeats)])
    scene, poses = structs.take(scene, index), poses[index].copy()
    mass, friction = np.array(scene.mass), np.array(scene.friction)
    for row, case in enumerate(index if perturbed else ()):
        rng = np.random.default_rng([seed, case, row % repeats])
        reach, angle = JITTER * np.sqrt(rng.uniform(size=slots)), rng.uniform(0, 2 * np.pi, slots)
        poses[row, :, :2] += reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        mass[row] *= rng.uniform(*MASS_FACTOR, slots)
        friction[row] *= rng.uniform(*FRICTION_FACTOR, slots)
    scene = scene.replace(mass=mass, friction=friction)
    rollout = primitives.settle(engine, scene, poses)
    wrong = np.flatnonzero(np.asarray(rollout.fault) & (Fault.UNUSABLE | Fault.OUTSIDE))
    if len(wrong):
        first = wrong[0]
        what = [name for name, hit in Fault.count(rollout.fault[first : first + 1]).items() if hit]
        raise UserError(
            f"case {found[index[first]]} of {path}: does not come to rest in the workspace ({', '.join(what)}); "
            "objects that overlap or stand at its edge must be moved"
        )
    return _instances([found[i] for i in index], scene, np.asarray(rollout.poses)[:, -1])


def random_instances(
    engine: Engine,
    config: scenes.SceneConfig,
    *,
    count: int,
    seed: int,
    purpose: seeds.Purpose = seeds.Purpose.CLEARING_TABLES,
) -> list[Instance]:
    """Return `count` random settled scenes, drawn with the key of `purpose`."""
    items = clutter.settled_scenes(seeds.key(seed, purpose), engine, config, count)
    return _instances([f"random-{i}" for i in range(count)], items.scene, np.asarray(items.poses))


def _instances(names: list[str], scene: Scene, poses: np.ndarray) -> list[Instance]:
    numbers = [zlib.crc32(f"{name}/{names[:i].count(name)}".encode()) for i, name in enumerate(names)]
    return [
        Instance(name, structs.take(scene, i), poses[i], int((scene.shape[i] >= 0).sum()), numbers[i])
        for i, name in enumerate(names)
    ]
