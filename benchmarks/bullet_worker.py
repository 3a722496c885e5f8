"""The same drop and push in PyBullet, in one process; it imports no JAX, and every core runs one."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

CONTROL_PERIOD = 0.01
"""Seconds between set points of the gripper, as in the project's own engines."""
WAITING_POSITION = (0.0, 0.0, 2.0)
"""Position in metres where the gripper waits while objects fall."""
GRIPPER_FORCE = 100.0
"""Largest force in newtons that moves the gripper."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """The settings of PyBullet that decide how accurate it is."""

    timestep: float  # seconds
    iterations: int


@dataclasses.dataclass(frozen=True)
class Work:
    """The scenes for one process as plain arrays; E scenes of N objects."""

    settings: Settings
    vertices: list[list[np.ndarray]]  # [E][N] corners [K, 3] metres, object's frame
    boxes: np.ndarray  # [E, N] bool: a cuboid, which PyBullet need not take as a mesh
    size: np.ndarray  # [E, N, 3] metres
    mass: np.ndarray  # [E, N] kg
    inertia: np.ndarray  # [E, N, 3] kg m^2
    friction: np.ndarray  # [E, N] with the table
    poses: np.ndarray  # [E, N, 7] metres, wxyz: in mid-air
    aimed: np.ndarray  # [E] the object that is pushed
    paths: np.ndarray  # [E, T, 4] x, y (from that object), z of the gripper's middle and its yaw, one a control period
    gripper: tuple[float, float, float]  # metres: half sides
    gripper_mass: float
    settle_time: float  # seconds
    watch: bool = False  # look at the contacts after every step of the fall


def ready(_: int) -> bool:
    """Import what `episodes` needs, so that the import is not timed."""
    import pybullet

    return bool(pybullet.isNumpyEnabled())


def episodes(work: Work) -> tuple[np.ndarray, np.ndarray]:
    """Drop, settle and push every scene.

    Returns:
      Positions `[E, N, 3]` at the end, and, if watched, the depths `[D]` (metres) of all contacts during the fall.
    """
    import pybullet

    client, timestep = pybullet.connect(pybullet.DIRECT), work.settings.timestep
    ends, depths = [], []
    for index in range(len(work.poses)):
        bodies, hand, held = _world(pybullet, client, work, index)
        look = functools.partial(_depths, bodies=bodies) if work.watch else _nothing
        depths += _steps(pybullet, client, round(work.settle_time / timestep), look)
        path = work.paths[index].copy()
        aimed = bodies[work.aimed[index]]
        path[:, :2] += pybullet.getBasePositionAndOrientation(aimed, physicsClientId=client)[0][:2]
        pybullet.resetBasePositionAndOrientation(hand, *_placed(pybullet, path[0]), physicsClientId=client)
        done = 0
        for tick, target in enumerate(path, 1):
            place, turn = _placed(pybullet, target)
            pybullet.changeConstraint(held, place, turn, maxForce=GRIPPER_FORCE, physicsClientId=client)
            due = round(tick * CONTROL_PERIOD / timestep)  # no whole number of steps fits a period
            _steps(pybullet, client, due - done)
            done = due
        found = [pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0] for body in bodies]
        ends.append(np.array(found))
    pybullet.disconnect(client)
    return np.array(ends), np.concatenate([np.zeros(0), *depths])


def _placed(bullet: Any, target: np.ndarray) -> tuple[list[float], tuple[float, ...]]:
    """Return position and quaternion of the gripper at `target [4]`."""
    return list(target[:3]), bullet.getQuaternionFromEuler([0.0, 0.0, float(target[3])])


def _nothing(bullet: Any, client: int) -> np.ndarray:
    return np.zeros(0)


def _steps(bullet: Any, client: int, count: int, look: Callable[..., np.ndarray] = _nothing) -> list[np.ndarray]:
    """Step `count` times and return what `look` returns after each step."""
    seen = []
    for _ in range(count):
        bullet.stepSimulation(physicsClientId=client)
        seen.append(look(bullet, client))
    return seen


def _world(bullet: Any, client: int, work: Work, index: int) -> tuple[list[int], int, int]:
    """Build the table, objects and gripper of one scene; return the objects, the gripper and its constraint."""
    at = {"physicsClientId": client}
    bullet.resetSimulation(**at)
    bullet.setGravity(0, 0, -9.81, **at)
    bullet.setTimeStep(work.settings.timestep, **at)
    bullet.setPhysicsEngineParameter(numSolverIterations=work.settings.iterations, **at)
    floor = bullet.createMultiBody(0, bullet.createCollisionShape(bullet.GEOM_PLANE, **at), **at)
    bullet.changeDynamics(floor, -1, lateralFriction=1.0, **at)  # Bullet multiplies the two coefficients
    bodies = [_object(bullet, client, work, index, slot) for slot in range(work.poses.shape[1])]
    shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=work.gripper, **at)
    hand = bullet.createMultiBody(work.gripper_mass, shape, basePosition=WAITING_POSITION, **at)
    held = bullet.createConstraint(hand, -1, -1, -1, bullet.JOINT_FIXED, [0, 0, 0], [0, 0, 0], WAITING_POSITION, **at)
    bullet.changeConstraint(held, WAITING_POSITION, maxForce=GRIPPER_FORCE, **at)
    return bodies, hand, held


def _object(bullet: Any, client: int, work: Work, index: int, slot: int) -> int:
    at = {"physicsClientId": client}
    pose = work.poses[index, slot]
    if work.boxes[index, slot]:
        half = list(work.size[index, slot] / 2)
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, **at)
    else:
        corners = work.vertices[index][slot].tolist()
        shape = bullet.createCollisionShape(bullet.GEOM_MESH, vertices=corners, **at)
    turn = [*pose[4:], pose[3]]
    body = bullet.createMultiBody(float(work.mass[index, slot]), shape, -1, list(pose[:3]), turn, **at)
    inertia = list(work.inertia[index, slot])
    friction = float(work.friction[index, slot])
    bullet.changeDynamics(body, -1, lateralFriction=friction, localInertiaDiagonal=inertia, **at)
    return body


def _depths(bullet: Any, client: int, bodies: list[int]) -> np.ndarray:
    """Return by how many metres the objects are in what they touch, one for each contact under load."""
    points = {}
    for body in bodies:
        for point in bullet.getContactPoints(body, physicsClientId=client):
            points[point[1], point[2], point[5]] = max(0.0, -point[8]) if point[9] > 0 else None
    return np.array([depth for depth in points.values() if depth is not None])
