"""Small scenes in which much happens, for tests: a heap that falls, a push, a grasp, an object on two others."""

import numpy as np

from dipn_jax.structs import ABSENT, Scene
from dipn_jax.world import scenes, shapes

SLOTS = 3
"""Object slots of a scene."""
PERIODS = 30
"""Control periods for which the hand moves."""
MOST = 80
"""Contacts of a scene of at most ten objects."""
CLASS = {name: i for i, name in enumerate(shapes.CLASSES)}
LYING = [1.0, 0, 0, 0]
HIGH, OPEN = ([0.1, 0, 0.3, 0, finger, finger] for finger in (0.03, 0.045))
"""Set points of a hand that touches nothing; the fingers of the second press on their stops, but not much, for the
solver ends where it can still lower the cost by a small share of all of it."""
RECORDED: dict[str, tuple[list[tuple[str, list[float], list[float]]], list[float], list[float]]] = {
    "a heap falls": (
        [
            ("cuboid", [0.06, 0.05, 0.04], [0, 0, 0.03, 0.9, 0.3, 0.2, 0.1]),
            ("concave", [0.08, 0.04, 0.05], [0.01, 0.01, 0.1, 0.8, 0.1, 0.5, 0.2]),
            ("triangular_prism", [0.06, 0.05, 0.04], [-0.01, 0.01, 0.16, 0.7, 0.2, 0.1, 0.6]),
        ],
        HIGH,
        OPEN,
    ),
    "a push": (
        [
            ("cylinder", [0.05, 0.05, 0.05], [0.04, 0.005, 0.025, *LYING]),
            ("half_cylinder", [0.06, 0.05, 0.03], [0.1, 0.01, 0.015, *LYING]),
            ("cuboid", [0.05, 0.05, 0.05], [0.1, -0.06, 0.025, *LYING]),
        ],
        [-0.03, 0, 0.02, 0.1, 0.003, 0.003],
        [0.05, 0.01, 0.02, 0.1, 0.003, 0.003],
    ),
    "a hand closes": (
        [
            ("cuboid", [0.05, 0.06, 0.05], [0.002, 0, 0.025, *LYING]),
            ("cylinder", [0.04, 0.04, 0.05], [0.002, 0, 0.0749, *LYING]),
            ("cuboid", [0.03, 0.03, 0.03], [0.1, 0.1, 0.015, *LYING]),
        ],
        [0, 0, 0.02, 0.05, 0.037, 0.037],
        [0, 0, 0.06, 0.05, 0.0, 0.0],
    ),
    "one lies across two": (
        [
            ("cuboid", [0.04, 0.06, 0.05], [-0.05, 0, 0.025, *LYING]),
            ("cylinder", [0.05, 0.05, 0.05], [0.05, 0, 0.025, *LYING]),
            ("triangular_prism", [0.16, 0.04, 0.03], [0, 0.005, 0.0651, 0.998, 0, 0, 0.06]),
        ],
        HIGH,
        HIGH,
    ),
    "two slots are empty": (
        [("half_cylinder", [0.06, 0.05, 0.03], [0, 0, 0.05, 0.6, 0.5, 0.3, 0.2])],
        [0.1, 0, 0.02, 0.3, 0.003, 0.003],
        [0.02, 0, 0.02, 0.5, -0.002, -0.002],
    ),
}
"""Scenes that are recorded, by what happens: objects (class, size, pose), and the hand's first and last set points."""


def scenes_with_control() -> tuple[Scene, np.ndarray, np.ndarray]:
    """Return the recorded scenes `[B]`, poses `[B, N, 7]` and the hand's set points `[PERIODS, B, 6]`."""
    batch = len(RECORDED)
    shape, size = np.full((batch, SLOTS), ABSENT, np.int32), np.full((batch, SLOTS, 3), 0.05, np.float32)
    poses = np.tile(np.array(scenes.parked(SLOTS)), (batch, 1, 1))
    for b, (objects, _, _) in enumerate(RECORDED.values()):
        for slot, (name, extent, pose) in enumerate(objects):
            shape[b, slot], size[b, slot], poses[b, slot] = CLASS[name], extent, pose
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    mass = np.where(shape >= 0, 500 * shapes.volume(shape, size), 0.1).astype(np.float32)
    friction = np.linspace(0.25, 0.5, shape.size, dtype=np.float32).reshape(shape.shape)
    first, last = (np.array([each[i] for each in RECORDED.values()]) for i in (1, 2))
    share = np.linspace(0, 1, PERIODS)[:, None, None]
    control = (first + share * (last - first)).astype(np.float32)
    return Scene(shape, size, np.zeros_like(size), mass, friction), poses.astype(np.float32), control
