"""The columns of an export: their names, shapes, units and values, as plain arrays in the units of the library.

A column is described once, by a `Column`; the files of every format, and the card beside them, follow from that.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from dipn_jax.structs import ABSENT, Fault
from dipn_jax.workspace import PUSH_STEPS, WORKSPACE
from dipn_jax.world import shapes

Values = dict[str, np.ndarray]
"""Values of columns `[B, ...]` by the name of the column."""
FRAMES = PUSH_STEPS + 1
"""Number of instants at which the poses of a push are recorded."""
PIXELS = WORKSPACE.pixels
"""Rows and columns of a picture."""
MOMENTS: dict[str, tuple[str, ...]] = {
    "none": (),
    "before": ("before",),
    "after": ("after",),
    "both": ("before", "after"),
    "all": ("all",),
}
"""What is rendered for each value of `--images`."""


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of an export: a value for each episode, or for each of its steps."""

    name: str
    shape: tuple[int | str, ...]  # `N` is the number of object slots
    dtype: str  # of NumPy
    meaning: str  # with unit and frame

    @property
    def flat_name(self) -> str:
        """Return the name in a table, where an array is a flat list: it ends in the shape, such as `poses_11xNx7`."""
        return "_".join([self.name, *(["x".join(map(str, self.shape))] if self.shape else [])])

    def lengths(self, slots: int) -> tuple[int, ...]:
        """Return the shape with a number in place of `N`."""
        return tuple(slots if length == "N" else int(length) for length in self.shape)


_CLASSES = ", ".join(f"{number} {name}" for number, name in enumerate(shapes.CLASSES))
_BITS = ", ".join(f"{bit} {name}" for bit, name in Fault.NAMES.items())
_POSE = "position (metres) and quaternion wxyz of every object, workspace frame"
_HEAD = (
    Column("episode", (), "int64", "number in the data set, as `dipn-datagen replay` takes it"),
    Column("scene", (), "int64", "number of the scene; actions tried on one scene share it, and its split"),
    Column("objects", (), "int32", "number of objects; the other slots are empty"),
    Column("shape", ("N",), "int32", f"class of each object: {_CLASSES}; {ABSENT} where the slot is empty"),
    Column("size", ("N", 3), "float32", "metres: bounding box along the object's own axes"),
    Column("color", ("N", 3), "float32", "RGB in [0, 1]"),
    Column("mass", ("N",), "float32", "kg"),
    Column("friction", ("N",), "float32", "sliding coefficient between the object and the table"),
)
_FAULT = Column("fault", (), "int32", f"sum of bits: {_BITS}; 0 where nothing went wrong")
_POSES = Column("poses", ("N", 7), "float32", f"before the action: {_POSE}")
_OF_KIND: dict[str, tuple[Column, ...]] = {
    "push": (
        Column("poses", (FRAMES, "N", 7), "float32", f"before, then after 1, ..., 10 cm of travel: {_POSE}"),
        Column("after", ("N", 7), "float32", f"at rest, the gripper gone: {_POSE}"),
        Column("push_x", (), "float32", "metres, workspace: where the gripper comes down"),
        Column("push_y", (), "float32", "metres, workspace: where the gripper comes down"),
        Column("push_angle", (), "float32", "radians from +x toward +y: direction of travel"),
        Column("push_distance", (), "float32", "metres of travel"),
    ),
    "grasp": (
        _POSES,
        Column("after", ("N", 7), "float32", f"after the lift: {_POSE}"),
        Column("grasp_x", (), "float32", "metres, workspace: midpoint between the fingers"),
        Column("grasp_y", (), "float32", "metres, workspace: midpoint between the fingers"),
        Column("grasp_angle", (), "float32", "radians from +x toward +y: direction of the closing axis"),
        Column("grasp_height", (), "float32", "metres: fingertips above the table"),
        Column("held", ("N",), "bool", "objects in the hand after the lift"),
        Column("success", (), "bool", "whether at least one is"),
    ),
    "images": (_POSES,),
}


def of_episodes(kind: str, images: str) -> tuple[Column, ...]:
    """Return the columns of episodes of a kind, with those of the pictures that `--images` asks for."""
    drawn = (column for moment in MOMENTS[images] for column in pictures(moment))
    return (*_HEAD, *_OF_KIND[kind], _FAULT, *drawn)


def pictures(moment: str) -> tuple[Column, ...]:
    """Return the columns of what the camera sees at one moment, or at all recorded ones (`all`)."""
    many = (FRAMES,) if moment == "all" else ()
    when = "before, then after 1, ..., 10 cm" if moment == "all" else f"{moment} the action"
    return (
        Column(f"height_{moment}", (*many, PIXELS, PIXELS), "float32", f"{when}: metres above the table"),
        Column(f"color_{moment}", (*many, PIXELS, PIXELS, 3), "uint8", f"{when}: RGB, 0 to 255"),
        Column(f"label_{moment}", (*many, PIXELS, PIXELS), "int8", f"{when}: object slot, {ABSENT} on the table"),
    )


def values(kind: str, episodes: Any, numbers: np.ndarray, scenes: np.ndarray) -> Values:
    """Return the columns of episodes `[B]`, without pictures, by name.

    Args:
      kind: of the data set.
      episodes: as `records.load` returns them.
      numbers: `[B]` numbers of the episodes.
      scenes: `[B]` numbers of their scenes.
    """
    scene = episodes.scene
    found = {"episode": numbers, "scene": scenes, "objects": (np.asarray(scene.shape) != ABSENT).sum(-1)}
    found |= {name: getattr(scene, name) for name in ("shape", "size", "color", "mass", "friction")}
    found["poses"] = episodes.poses
    if kind == "push":
        x, y = np.moveaxis(np.asarray(episodes.push.start), -1, 0)
        found |= {"after": episodes.after, "push_x": x, "push_y": y}
        found |= {"push_angle": episodes.push.angle, "push_distance": episodes.push.distance}
    elif kind == "grasp":
        x, y = np.moveaxis(np.asarray(episodes.grasp.center), -1, 0)
        found |= {"after": episodes.after, "grasp_x": x, "grasp_y": y, "grasp_angle": episodes.grasp.angle}
        found |= {"grasp_height": episodes.grasp.height, "held": episodes.held, "success": episodes.success}
    found["fault"] = episodes.fault
    return {
        column.name: np.asarray(found[column.name]).astype(column.dtype) for column in (*_HEAD, *_OF_KIND[kind], _FAULT)
    }
