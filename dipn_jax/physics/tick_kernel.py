"""The Warp kernel of `tick`, made of C++ (`tick_*.h` and what they build on). Importing this imports Warp.

Warp reads annotations itself, so they are no strings here, and the shape checks of tests leave the functions alone.
"""

import functools
import threading
import typing
from typing import Any

import mujoco
import numpy as np
import warp as wp

from dipn_jax.physics import cpp
from dipn_jax.world import model, shapes

LANES = 32
"""Threads that share a scene: a warp."""
ROWS = 3
"""The hand's own constraints: the fingers open equally wide, and each has stops."""
FILES = (*cpp.SOLVER, *cpp.NARROW, "tick_motion.h", "tick_contacts.h", "tick_begin.h")
"""C++ of a control period, but for its loop over time steps, `tick_main.h`."""
HAND, LEFT, RIGHT = 1, 2, 3
"""Bodies of the model."""
_ONE_AT_A_TIME = threading.Lock()
"""Warp keeps functions by name until a kernel has read them, so another thread's C++ could come in between."""

Numbers = tuple[tuple[tuple[str, float], ...], tuple[tuple[str, tuple[float, ...]], ...]]
"""Numbers by name, and lists of numbers by name."""


def numbers(m: mujoco.MjModel) -> Numbers:
    """Return what the kernel takes from a model of our MJCF, by the names in its C++: numbers, and lists of numbers."""
    contact = _rule(m, m.geom_solref[0], m.geom_solimp[0])
    values = {
        "STEP": m.opt.timestep,
        "GRAVITY": m.opt.gravity[2],
        "MASS_HAND": m.body_mass[HAND],
        "MASS_LEFT": m.body_mass[LEFT],
        "MASS_RIGHT": m.body_mass[RIGHT],
        "INERTIA_YAW": m.body_inertia[HAND : RIGHT + 1, 2].sum() + m.dof_armature[3],
        "FINGER_LIGHT": m.body_invweight0[LEFT, 0],
        "LINK_FRICTION": m.geom_friction[1, 0],
        "PAD_FRICTION": m.geom_friction[2, 0],
        "OBJECT_RATIO": model.OBJECT_FRICTION_RATIO,
        "ROOT_IMPRATIO": np.sqrt(m.opt.impratio),
        "EQUAL_LIGHT": m.dof_invweight0[4] + m.dof_invweight0[5],
        "STOP_LIGHT": m.dof_invweight0[4],
        "LEAST_OPEN": m.jnt_range[4, 0],
        "MOST_OPEN": m.jnt_range[4, 1],
        "LEAST_RESISTANCE": mujoco.mjMINVAL,
    }
    lists = {
        "GAIN": m.actuator_gainprm[:, 0],
        "DAMPING": -m.actuator_biasprm[:, 2],
        "LEAST_FORCE": m.actuator_forcerange[:, 0],
        "MOST_FORCE": m.actuator_forcerange[:, 1],
        "CONTACT_RULE": contact,
        "EQUAL_RULE": _rule(m, m.eq_solref[0], m.eq_solimp[0]),
        "STOP_RULE": _rule(m, m.jnt_solref[4], m.jnt_solimp[4]),
    }
    plain = tuple((name, float(value)) for name, value in values.items())
    return plain, tuple((name, tuple(map(float, value))) for name, value in lists.items())


def _rule(m: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray) -> list[float]:
    """Return stiffness, damping and the five numbers of the impedance of a kind of constraint, as `_kbi` of MJX."""
    time, ratio = solref
    least, most, width, middle, power = solimp
    least, most, middle = np.clip([least, most, middle], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    time = max(time, 2 * m.opt.timestep)
    stiffness = 1 / (most * time * ratio) ** 2 if solref[0] > 0 else -solref[0] / most**2
    damping = 2 / (most * time) if solref[1] > 0 else -solref[1] / most
    return [stiffness, damping, least, most, max(width, mujoco.mjMINVAL), middle, max(power, 1)]


def source(blocks: int, contacts: int, model_numbers: Numbers, main: str) -> str:
    """Return the C++ of a control period with room for that many blocks and contacts of a scene; `main` comes last."""
    values, lists = model_numbers
    return cpp.source(
        FILES,
        main,
        room={"BLOCKS": blocks, "CONTACTS": contacts, "ROWS": ROWS, "PARTS": shapes.CONVEX_PARTS} | cpp.NARROW_ROOM,
        numbers=cpp.SOLVER_NUMBERS | cpp.NARROW_NUMBERS | dict(values),
        lists=dict(lists),
    )


@functools.cache
def kernel(blocks: int, contacts: int, model_numbers: Numbers) -> Any:
    """Return the kernel with room for that many blocks (the hand and objects) and contacts of a scene.

    It is launched with `LANES` threads a scene and blocks of that size. Arrays are flat, scene after scene; a scene has
    `blocks - 1` object slots of three geoms each, after the floor's and the gripper's four geoms:

    - `vertex [geoms, 24, 3]` and `face_normal [geoms, 14, 3]` in each geom's own frame, prisms as by `prisms.parts`;
    - `radius [geoms]` of a ball about the place of a geom; negative: it touches nothing;
    - `center [geoms, 3]`: places of geoms in the frames of their bodies;
    - `body_mass`, `friction [slots]` (with the table) and `inertia [slots, 3]`;
    - `control [6]`: set points of the motors; `push [6 blocks]`: forces from outside;
    - `qpos [6 + 7 slots]`, `qvel` and `warmstart [6 blocks]`: see `recording.State`;
    - `most`: contacts that a scene may have; `substeps`: time steps; `iterations` and `tries`: most of Newton's steps,
      and of tries of a line search;
    - out: `qpos`, `qvel` and `warmstart` after the time steps, `full` (whether there were `most` contacts or more in
      any of them) and `depth` (metres, of the deepest contact in the last).

    Threads may call it side by side.
    """
    with _ONE_AT_A_TIME:
        return _made(source(blocks, contacts, model_numbers, cpp.read("tick_main.h")))


def _made(text: str) -> Any:
    """Return the kernel whose C++ is `text`."""
    floats: Any
    integers: Any
    floats, integers = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32)

    @wp.func_native(text)
    @typing.no_type_check
    def advance_scene(
        vertex: floats, face_normal: floats, radius: floats, center: floats, body_mass: floats, inertia: floats,
        friction: floats, control: floats, push: floats, qpos: floats, qvel: floats, warmstart: floats, blocks: int,
        most: int, substeps: int, iterations: int, tries: int, qpos_out: floats, qvel_out: floats,
        warmstart_out: floats, full_out: integers, depth_out: floats, scene: int, lane: int,
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False, module_options={"block_dim": LANES})
    @typing.no_type_check
    def advance(
        vertex: floats, face_normal: floats, radius: floats, center: floats, body_mass: floats, inertia: floats,
        friction: floats, control: floats, push: floats, qpos: floats, qvel: floats, warmstart: floats, blocks: int,
        most: int, substeps: int, iterations: int, tries: int, qpos_out: floats, qvel_out: floats,
        warmstart_out: floats, full_out: integers, depth_out: floats,
    ):  # fmt: skip
        scene, lane = wp.tid()
        advance_scene(
            vertex, face_normal, radius, center, body_mass, inertia, friction, control, push, qpos, qvel, warmstart,
            blocks, most, substeps, iterations, tries, qpos_out, qvel_out, warmstart_out, full_out, depth_out, scene,
            lane,
        )  # fmt: skip

    return advance
