"""Episodes as steps with observations and actions, as imitation learning wants them.

A push has 11 steps, one at each recorded centimetre (every 0.1 s); a grasp and a scene have one.
"""

from __future__ import annotations

import numpy as np

from .columns import FRAMES, Column, Values, of_episodes

FPS = 10
"""Steps a second: the gripper travels at 10 cm a second."""
_GRIPPER = "x, y (metres, workspace) and angle (radians) of the gripper, as commanded"


def images_of(kind: str) -> tuple[str, ...]:
    """Return the values of `--images` that give each step of a kind its picture."""
    return ("none", "all" if kind == "push" else "before")


def step_columns(kind: str, images: str) -> tuple[Column, ...]:
    """Return what each step has: observations, and for pushes and grasps `action`.

    Args:
      kind: of the data set.
      images: one of `images_of(kind)`.
    """
    every = {column.name: column for column in of_episodes(kind, images)}
    many = kind == "push"

    def step(name: str, column: Column) -> Column:
        return Column(name, column.shape[1:] if many else column.shape, column.dtype, column.meaning)

    found = [step("poses", every["poses"])]
    found += [step(name.rpartition("_")[0], every[name]) for name in every if name.endswith(("_all", "_before"))]
    if kind == "push":
        found.append(Column("gripper", (3,), "float32", _GRIPPER))
        found.append(Column("action", (3,), "float32", f"{_GRIPPER} for the next step"))
    elif kind == "grasp":
        what = "x, y (metres, workspace), angle of the closing axis (radians), height of the fingertips (metres)"
        found.append(Column("action", (4,), "float32", what))
    return tuple(found)


def episode_columns(kind: str) -> tuple[Column, ...]:
    """Return what each episode has beside its steps."""
    return tuple(column for column in of_episodes(kind, "none") if column.name != "poses")


def length(kind: str) -> int:
    """Return the number of steps of an episode."""
    return FRAMES if kind == "push" else 1


def steps(kind: str, values: Values) -> Values:
    """Return the columns of steps `[B, T, ...]` of episodes whose columns are `values [B, ...]`."""
    count, lead = len(values["episode"]), (lambda value: value if kind == "push" else value[:, None])
    found = {"poses": lead(values["poses"])}
    found |= {k.rpartition("_")[0]: lead(v) for k, v in values.items() if k.endswith(("_all", "_before"))}
    if kind == "push":
        travel = np.minimum(0.01 * np.arange(FRAMES + 1), values["push_distance"][:, None])  # [B, 12] metres
        angle = np.broadcast_to(values["push_angle"][:, None], travel.shape)
        x, y = (values[f"push_{axis}"][:, None] + travel * turn(angle) for axis, turn in (("x", np.cos), ("y", np.sin)))
        path = np.stack([x, y, angle], -1).astype(np.float32)
        path[:, -1] = path[:, -2]  # it stays where the last step is
        found |= {"gripper": path[:, :-1], "action": path[:, 1:]}
    elif kind == "grasp":
        names = [f"grasp_{name}" for name in ("x", "y", "angle", "height")]
        found["action"] = np.stack([values[name] for name in names], -1).reshape(count, 1, 4)
    return found
