"""Fixed dimensions of the table and of the gripper (static, hashable, metres)."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Workspace:
    """The square that the camera sees. Source: DIPN's released code (0.448 m, 2 mm a pixel)."""

    side: float = 0.448  # metres
    pixels: int = 224  # along a side

    @property
    def half(self) -> float:
        """Half the side, in metres."""
        return self.side / 2

    @property
    def pixel(self) -> float:
        """The side of a pixel, in metres."""
        return self.side / self.pixels


@dataclasses.dataclass(frozen=True)
class Gripper:
    """A floating parallel-jaw gripper without an arm. Source of the gaps and widths: DIPN's released code.

    The closing axis is the gripper's own x; its pads are `pad_width` wide along its own y.
    """

    stroke: float = 0.074  # metres, inner gap when open
    thickness: float = 0.020  # metres, of a finger along the closing axis: outer gap 0.114 when open
    pad_depth: float = 0.006  # metres, the part of the thickness that is sticky
    pad_width: float = 0.020  # metres
    finger_length: float = 0.14  # metres
    push_gap: float = 0.006  # metres, inner gap while pushing: outer width 0.046
    mass: float = 1.0  # kg, hand
    finger_mass: float = 0.1  # kg, each
    bandwidth: float = 100.0  # rad/s of the critically damped position loop
    grip_force: float = 15.0  # N, most that a finger closes with
    hand_force: float = 60.0  # N, most that the hand presses down with
    push_tip: float = 0.02  # metres, height of the tip while pushing
    lift: float = 0.15  # metres, by which a grasped object is lifted

    @property
    def lag(self) -> float:
        """Seconds by which the position loop follows a ramp late: velocity gain over position gain."""
        return 2.0 / self.bandwidth

    @property
    def push_width(self) -> float:
        """The width of the closed gripper across its travel, in metres."""
        return self.push_gap + 2 * self.thickness


WORKSPACE = Workspace()
"""The workspace that the whole project uses."""
GRIPPER = Gripper()
"""The gripper that the whole project uses."""
TURNED_PIXELS = 320
"""Side in pixels of a map that holds the workspace at any angle (source: the paper's GN input)."""
ROTATIONS = 16
"""Number of directions of grasps and pushes, evenly in [0, 2 pi)."""
PUSH_STEPS = 10
"""Length of a recorded push in centimetres."""
LOWEST_TIP = 0.02
"""Lowest height in metres at which the fingertips close: what is not higher is beyond their reach."""


def grasp_angles() -> np.ndarray:
    """Return the 16 angles of the closing axis `[16]` in radians."""
    return (np.arange(ROTATIONS) * (2 * np.pi / ROTATIONS)).astype(np.float32)
