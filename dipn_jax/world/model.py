"""The MJCF model of a scene: the one description of the world that every engine reads.

The number of slots fixes the layout (bodies, joints, geoms), so models of different scenes with the same
number of slots can run in one batch. `generic=True` gives every part the same placeholder mesh: the engine that
traces geometry (MJX) replaces its vertices, and compiles once for all scenes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dipn_jax.engine import PhysicsConfig
from dipn_jax.structs import Scene
from dipn_jax.workspace import GRIPPER
from dipn_jax.world import shapes

MARK = "dipn_jax"
"""Name of a custom number in our MJCF that marks a model as ours (`physics.patches` looks for it)."""
GRIPPER_DOF = 6
"""Degrees of freedom of the gripper: x, y, z, yaw, two fingers. Each object follows with 7 qpos and 6 qvel."""
OBJECT_FRICTION_RATIO = 0.5 / 0.35
"""Friction between objects over that between object and table. Source: DIPN's released code."""


def _gripper() -> str:
    g = GRIPPER
    length, width = g.finger_length / 2, g.pad_width / 2
    link = (g.thickness - g.pad_depth) / 2
    fingers = []
    for name, sign in (("left", 1), ("right", -1)):
        fingers.append(
            f'<body name="{name}" gravcomp="1">'
            f'<joint name="{name}" type="slide" axis="{sign} 0 0" range="0 {g.stroke / 2 + 0.002}"/>'
            f'<inertial pos="0 0 {length}" mass="{g.finger_mass}" diaginertia="1e-4 1e-4 1e-4"/>'
            f'<geom class="link" name="{name}_link" type="box" pos="{sign * (g.pad_depth + link)} 0 {length}" '
            f'size="{link} {width} {length}"/>'
            f'<geom class="pad" name="{name}_pad" type="box" pos="{sign * g.pad_depth / 2} 0 {length}" '
            f'size="{g.pad_depth / 2} {width} {length}"/></body>'
        )
    return (
        '<body name="hand" gravcomp="1">'
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
        '<joint name="z" type="slide" axis="0 0 1"/><joint name="yaw" type="hinge" axis="0 0 1" armature="0.008"/>'
        f'<inertial pos="0 0 {g.finger_length}" mass="{g.mass}" diaginertia="2e-3 2e-3 2e-3"/>'
        f"{''.join(fingers)}</body>"
    )


def _actuators() -> str:
    g = GRIPPER
    moved = g.mass + 2 * g.finger_mass
    rows = []
    for name, inertia, force in (
        ("x", moved, 100.0),
        ("y", moved, 100.0),
        ("z", moved, g.hand_force),
        ("yaw", 0.0105, 10.0),
    ):
        kp, kv = inertia * g.bandwidth**2, 2 * inertia * g.bandwidth
        rows.append(f'<position joint="{name}" kp="{kp}" kv="{kv}" forcerange="-{force} {force}"/>')
    for name in ("left", "right"):
        rows.append(f'<position joint="{name}" kp="1000" kv="30" forcerange="-{g.grip_force} {g.grip_force}"/>')
    return "".join(rows)


def _text(values: np.ndarray) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.ravel(values))


def _object(scene: Scene, slot: int, generic: bool, inertia: np.ndarray) -> tuple[str, str]:
    """Return the body and the mesh assets of one slot; empty slots and missing parts get geoms that touch nothing."""
    shape, size = int(scene.shape[slot]), np.asarray(scene.size[slot], float)
    present = shape >= 0
    name = shapes.CLASSES[max(shape, 0)]
    mu = float(scene.friction[slot]) * OBJECT_FRICTION_RATIO if present else 1.0
    geoms, assets = [], []
    for part in range(shapes.CONVEX_PARTS):
        corners = int(shapes.CORNERS_USED[max(shape, 0), part]) if present else 0
        common = f'name="o{slot}p{part}" friction="{mu:.9g} 0.005 0.0001"'
        if generic:
            geoms.append(f'<geom class="object" {common} type="mesh" mesh="part"/>')
        elif corners == 0:
            geoms.append(f'<geom class="object" {common} type="sphere" size="1e-4" contype="8" conaffinity="8"/>')
        elif name == "cuboid":
            geoms.append(f'<geom class="object" {common} type="box" size="{_text(size / 2)}"/>')
        else:
            assets.append(_mesh(f"o{slot}p{part}", shape, part, size))
            geoms.append(f'<geom class="object" {common} type="mesh" mesh="o{slot}p{part}"/>')
    mass = float(scene.mass[slot]) if present else 0.1
    inertial = f'<inertial pos="0 0 0" mass="{mass:.9g}" diaginertia="{_text(inertia)}"/>'
    return f'<body name="o{slot}"><freejoint name="o{slot}"/>{inertial}{"".join(geoms)}</body>', "".join(assets)


def inertias(scene: Scene) -> Float[np.ndarray, "*b N 3"]:
    """Return the diagonal inertia (kg m^2) of every slot; that of a harmless ball for empty slots."""
    spread = shapes.UNIT_VARIANCE[np.maximum(scene.shape, 0)] * np.asarray(scene.size, float) ** 2
    inertia = np.asarray(scene.mass, float)[:, None] * (spread.sum(-1, keepdims=True) - spread)
    return np.where((np.asarray(scene.shape) >= 0)[:, None], inertia, 1e-4)


def _fillers(scene: Scene) -> str:
    """Return meshes that no geom uses, so that the bounding volumes of all scenes' meshes have as many nodes.

    f triangles have 2 f - 1 nodes: a prism of n sides, with f = 4 n - 4, and a double pyramid, with f = 2 n.
    """
    shape = np.asarray(scene.shape)
    sides = shapes.CORNERS_USED[np.maximum(shape, 0)]
    meshes = (sides > 0) & ((shape >= 0) & (shape != shapes.CLASSES.index("cuboid")))[:, None]
    most = len(shape) * (8 * shapes.CORNERS - 9)  # no object has more
    missing = most + 44 - int((8 * sides - 9)[meshes].sum())  # from 44 on, any number can be made up
    count = -missing % 4 or 4
    pyramids = [3] * (count - 1) + [(missing + count) // 4 - 3 * (count - 1)]
    return "".join(_double_pyramid(f"filler{i}", n) for i, n in enumerate(pyramids))


def _double_pyramid(name: str, sides: int) -> str:
    """Return a mesh with explicit faces: without them MuJoCo would compute a convex hull."""
    angle, at = 2 * np.pi * np.arange(sides) / sides, np.arange(sides)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], -1)
    corners = np.round(0.05 * np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]]), 5)  # short to write
    upper = np.stack([at, (at + 1) % sides, np.full(sides, sides)], -1)
    faces = " ".join(map(str, np.concatenate([upper, upper[:, ::-1] + np.array([1, 0, 0])]).ravel()))
    return f'<mesh name="{name}" inertia="shell" vertex="{_text(corners)}" face="{faces}"/>'


def _mesh(name: str, shape: int, part: int, size: np.ndarray) -> str:
    rings, corners = shapes.UNIT_VERTICES[shape, part] * size, int(shapes.CORNERS_USED[shape, part])
    vertices = np.concatenate([rings[:corners], rings[shapes.CORNERS : shapes.CORNERS + corners]])
    return f'<mesh name="{name}" vertex="{_text(vertices)}"/>'


def mjcf(
    scene: Scene,
    *,
    config: PhysicsConfig,
    generic: bool = False,
    alike: bool = False,
) -> str:
    """Return the world as an MJCF document.

    Args:
      scene: one scene (no batch axis), numpy arrays; empty slots are kept as bodies that touch nothing.
      config: solver settings.
      generic: placeholder geometry in every part (see the module's docstring).
      alike: add meshes that nothing uses, so that all scenes with the same number of slots have models of one layout.

    Returns:
      XML text. qpos is `[x, y, z, yaw, left, right, (position, quaternion) of every slot]`.
    """
    spin = inertias(scene)
    n = len(scene.shape)
    parts = [_object(scene, i, generic, spin[i]) for i in range(n)]
    floor = []
    for i in range(n):
        mu = float(scene.friction[i]) if scene.shape[i] >= 0 else 1.0
        for part in range(shapes.CONVEX_PARTS):
            alive = scene.shape[i] >= 0 and shapes.CORNERS_USED[int(scene.shape[i]), part] > 0
            gap = "" if generic or alive else ' margin="-1000"'
            floor.append(
                f'<pair geom1="floor" geom2="o{i}p{part}" friction="{mu:.9g} {mu:.9g} 0.005 0.0001 0.0001"{gap}/>'
            )
    extra = _fillers(scene) if alike else ""
    if generic:
        extra = _mesh("part", shapes.CLASSES.index("cylinder"), 0, np.full(3, 0.05))
    nearest = "" if generic else '<sensor><contact name="nearest" data="dist" reduce="mindist" num="1"/></sensor>'
    jacobian = "dense" if generic else "auto"  # sparse from nine objects on: 30 fall in 0.7 of the time
    pairs, contacts = config.caps(n)
    c, sleep = config, ' sleep="enable"' if config.sleep else ""
    return f"""<mujoco model="dipn">
<compiler angle="radian"/>
<option timestep="{c.timestep}" integrator="implicitfast" solver="Newton" cone="{c.cone}" impratio="{c.impratio}"
 iterations="{c.iterations}" ls_iterations="{c.ls_iterations}" tolerance="{c.tolerance}" jacobian="{jacobian}"
 sleep_tolerance="{c.sleep}"> <flag multiccd="enable" autoreset="disable"{sleep}/></option>
<custom><numeric name="max_geom_pairs" data="{pairs}"/>
 <numeric name="max_contact_points" data="{contacts}"/><numeric name="{MARK}" data="1"/></custom>
<default><geom solref="{c.solref}" solimp="{c.solimp}"/><pair condim="3" solref="{c.solref}" solimp="{c.solimp}"/>
 <default class="object"><geom contype="1" conaffinity="3" condim="3"/></default>
 <default class="link">
  <geom contype="2" conaffinity="0" condim="3" priority="1" friction="0.35 0.005 0.0001"/></default>
 <default class="pad"><geom contype="2" conaffinity="0" condim="4" priority="2" friction="1 0.01 0.0001"/></default>
</default>
<asset>{extra}{"".join(a for _, a in parts)}</asset>
<worldbody><geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/>
{_gripper()}
{"".join(b for b, _ in parts)}</worldbody>
<contact>{"".join(floor)}</contact>
<equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0" solref="0.005 1"/></equality>
<actuator>{_actuators()}</actuator>
{nearest}</mujoco>"""
