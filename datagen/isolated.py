"""Single objects at rest on the table, and centred antipodal grasps of them: the easiest grasps."""

from __future__ import annotations

import numpy as np
import scipy.spatial

from dipn_jax import geometry, structs
from dipn_jax.engine import Engine
from dipn_jax.sight import fingers
from dipn_jax.structs import Array, Fault, Grasp, Scene
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import primitives, scenes, shapes

MOST_OFFSET = 0.01
"""Metres by which a grasp is off centre at most, along each of the gripper's axes."""
MOST_TURN = np.deg2rad(7.5)
"""Radians by which a grasp is turned at most."""
WIDEST_OBJECT = GRIPPER.stroke - 2 * MOST_OFFSET - 0.002
"""Metres between two faces of an object at most, so that it fits between the fingers of every grasp that is tried."""
SAME_FACE_DEPTH = 1e-3
"""Metres below the outermost corner within which corners belong to the same face."""
LEAST_OVERLAP = np.array([0.01, 0.004])
"""Metres by which opposite faces overlap at least, seen along the closing axis: across, and above the tips."""
SIDES_DOWN = np.array(
    [[1, 0, 0, 0], [0, 1, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0], [0.5**0.5, -(0.5**0.5), 0, 0],
     [0.5**0.5, 0, 0.5**0.5, 0], [0.5**0.5, 0, -(0.5**0.5), 0]]
)  # fmt: skip
"""Orientations with each side of the bounding box at the bottom, `[6, 4]` wxyz."""
STABLE_MARGIN = 1e-3
"""Metres by which the centre of mass is inside the outline of a face that an object can stand on."""
HEAVY_MASS = 2.0
"""Kilograms of an object that a finger on top cannot press aside, and that can still be lifted."""


def random_single_objects(rng: np.random.Generator, item: shapes.Item, count: int) -> tuple[Scene, np.ndarray]:
    """Draw scenes `[count, 1]` of one object of random size, mass and friction, on any side, just above the table.

    Returns:
      Scenes and poses `[count, 1, 7]`.
    """
    scene = _items(rng, item, count)
    return scene, _set_down(rng, scene, SIDES_DOWN[np.arange(count) % len(SIDES_DOWN)])


def standing(rng: np.random.Generator, item: shapes.Item) -> tuple[Scene, np.ndarray]:
    """Draw an object and put it on every face that it can stand on, just above the table.

    Returns:
      Scenes `[F, 1]` and poses `[F, 1, 7]`.
    """
    one = _items(rng, item, 1)
    faces = stable_faces(int(one.shape[0, 0]), one.size[0, 0])
    scene = structs.take(one, np.zeros(len(faces), int))
    return scene, _set_down(rng, scene, faces)


def _items(rng: np.random.Generator, item: shapes.Item, count: int) -> Scene:
    """Draw scenes `[count, 1]` of one object each, of random size, mass and friction."""
    ranges = scenes.DEFAULT_RANGES
    shape = np.full((count, 1), shapes.CLASSES.index(item.shape), np.int32)
    size = np.array(item.size_mm) / 1000 * rng.uniform(*ranges.scale, (count, 1, 3))
    size = np.maximum(size, scenes.MIN_SIDE)
    mass = rng.uniform(*ranges.density, (count, 1)) * shapes.volume(shape, size)
    friction = rng.uniform(*ranges.friction, (count, 1))
    return structs.cast(Scene(shape, size, np.full((count, 1, 3), 0.5), mass, friction))


def _set_down(rng: np.random.Generator, scene: Scene, quat: np.ndarray) -> np.ndarray:
    """Draw poses `[B, 1, 7]` 2 mm above the table, turned by `quat [B, 4]` and then about the vertical at random."""
    yaw = np.asarray(geometry.quat_about_z(rng.uniform(-np.pi, np.pi, len(quat))))
    turned = np.asarray(geometry.quat_multiply(yaw, quat))
    poses = np.concatenate([np.zeros((len(quat), 3)), turned], -1)[:, None]
    poses[..., 2] = 0.002 - shapes.lowest_corner(scene.shape, scene.size, poses, xp=np)
    return poses.astype(np.float32)


def stable_faces(shape: int, size: Array) -> np.ndarray:
    """Return orientations `[F, 4]` (wxyz) that lay an object on each face of its hull that it can stand on.

    Args:
      shape: index into `shapes.CLASSES`.
      size: `[3]` metres.

    Returns:
      Orientations for the faces whose outline has the centre of mass inside, by at least STABLE_MARGIN.
    """
    corners = (shapes.UNIT_VERTICES[shape][shapes.CORNERS_USED[shape] > 0] * size).reshape(-1, 3)
    planes = scipy.spatial.ConvexHull(corners, qhull_options="Qt").equations  # n @ x + d <= 0 inside
    found = []
    for normal in np.unique(planes[:, :3].round(4), axis=0):
        normal = normal / np.linalg.norm(normal)
        height = corners @ normal
        across = np.linalg.svd(normal[None])[2][1:]  # two axes in the plane; the centre of mass is their origin
        outline = scipy.spatial.ConvexHull(corners[height > height.max() - 1e-5] @ across.T)
        if outline.equations[:, 2].max() < -STABLE_MARGIN:
            found.append(_turn_down(normal))
    return np.array(found)


def _turn_down(normal: np.ndarray) -> np.ndarray:
    """Return the shortest turn `[4]` (wxyz) that makes `normal [3]` point down."""
    down = np.array([0.0, 0.0, -1.0])
    quat = np.array([1 + normal @ down, *np.cross(normal, down)])
    return quat / np.linalg.norm(quat) if quat[0] > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])


def _corners(shape: int, size: Array, pose: np.ndarray) -> list[np.ndarray]:
    """Return the corners `[M, 3]` of each part of an object in the workspace."""
    turn = np.asarray(geometry.quat_to_matrix(pose[3:]))
    parts = shapes.UNIT_VERTICES[shape][shapes.CORNERS_USED[shape] > 0]
    return [(part * size) @ turn.T + pose[:3] for part in parts]


def _directions(shape: int, size: Array, pose: np.ndarray) -> np.ndarray:
    """Return the angles `[K]` of the normals of upright faces."""
    hull = shapes.hull(shape, size)
    normals = np.asarray(hull.normals)[np.asarray(hull.alive)].reshape(-1, 3)
    normals = normals @ np.asarray(geometry.quat_to_matrix(pose[3:])).T
    upright = (np.abs(normals[:, 2]) < 0.02) & (np.linalg.norm(normals, axis=-1) > 0.5)
    return np.unique(np.arctan2(normals[upright, 1], normals[upright, 0]).round(3) % np.pi)


def antipodal(shape: int, size: Array, pose: np.ndarray) -> Grasp | None:
    """Return the narrowest grasp of two upright, opposite faces of one part; None if all are wider than WIDEST_OBJECT.

    Args:
      shape: index into `shapes.CLASSES`.
      size: `[3]` metres.
      pose: `[7]` at rest.
    """
    parts = _corners(shape, size, pose)
    tip = float(fingers.grasp_height(max(part[:, 2].max() for part in parts)))
    found = []
    for angle in _directions(shape, size, pose):
        axis, side = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        low, high = (end([end(part[:, :2] @ axis) for part in parts]) for end in (min, max))
        for part in parts:
            along = part[:, :2] @ axis
            seen = np.stack([part[:, :2] @ side, part[:, 2]], -1)
            ends = [seen[high - along < SAME_FACE_DEPTH], seen[along - low < SAME_FACE_DEPTH]]
            if high - low > WIDEST_OBJECT or not (len(ends[0]) and len(ends[1])):
                continue
            left, right = np.max([e.min(0) for e in ends], 0), np.min([e.max(0) for e in ends], 0)
            left[1] = max(left[1], tip)
            if (right - left > LEAST_OVERLAP).all():
                middle = axis * (low + high) / 2 + side * (left[0] + right[0]) / 2
                found.append((round(high - low, 4), -np.prod(right - left), Grasp(middle, angle, np.asarray(tip))))
    return min(found, key=lambda entry: entry[:2])[2] if found else None


def share_held(engine: Engine, rng: np.random.Generator, item: shapes.Item, tries: int) -> tuple[float, int]:
    """Return the share of centred antipodal grasps that hold, and their number.

    They are off by MOST_OFFSET and MOST_TURN at most. Objects that cannot be grasped as they lie are not tried; the
    number is 0 if an item never can be.
    """
    scene, poses = random_single_objects(rng, item, 4 * tries)
    rest = primitives.settle(engine, scene, poses, duration=0.6)
    poses = np.asarray(rest.poses)[:, -1]
    planned = [
        None if rest.fault[i] else antipodal(int(scene.shape[i, 0]), scene.size[i, 0], poses[i, 0])
        for i in range(len(poses))
    ]
    index = np.array([i for i, grasp in enumerate(planned) if grasp is not None][:tries], int)
    if not len(index):
        return float("nan"), 0
    grasps = structs.stack([planned[i] for i in index])
    shift = rng.uniform(-MOST_OFFSET, MOST_OFFSET, (len(index), 2))
    center = grasps.center + np.asarray(geometry.rotate2d(shift, grasps.angle))
    angle = grasps.angle + rng.uniform(-MOST_TURN, MOST_TURN, len(index))
    grasps = structs.cast(grasps.replace(center=center, angle=angle))
    rollout, outcome = primitives.grasp(engine, structs.take(scene, index), poses[index], grasps)
    sound = Fault.usable(rollout.fault)
    return float(np.asarray(outcome.success)[sound].mean()), int(sound.sum())


def shares_of_long(engine: Engine, rng: np.random.Generator, tries: int) -> dict[str, float]:
    """Return the shares of grasps of a 100 mm cuboid that hold.

    The grasps close on the 100 mm side (`too_wide`), have a finger on top of a cuboid of HEAVY_MASS (`on_top`), or are
    centred on the same one (`heavy`), which only shows that it can be lifted.
    """
    item = next(item for item in shapes.CATALOGUE if item.name == "cuboid_long")
    scene, poses = random_single_objects(rng, item, tries)
    poses[:, 0, 2] -= 0.002
    poses[:, 0, 3:] = np.asarray(geometry.quat_about_z(np.linspace(0, 3, tries)))
    along = Grasp(poses[:, 0, :2], np.linspace(0, 3, tries), np.full(tries, 0.02))
    heavy = scene.replace(mass=np.full_like(scene.mass, HEAVY_MASS))
    axis = np.stack([-np.sin(along.angle), np.cos(along.angle)], -1)
    beside = along.replace(center=along.center + 0.045 * axis, angle=along.angle + np.pi / 2)
    middle = along.replace(angle=along.angle + np.pi / 2)
    tried = {"too_wide": (scene, along), "on_top": (heavy, beside), "heavy": (heavy, middle)}
    shares = {}
    for name, (objects, grasps) in tried.items():
        _, outcome = primitives.grasp(engine, objects, poses, structs.cast(grasps))
        shares[name] = float(np.asarray(outcome.success).mean())
    return shares
