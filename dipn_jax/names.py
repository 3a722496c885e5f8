"""The names of engines, methods and aids, which are values of options.

Importing this imports no JAX, so `--help` answers at once.
"""

from __future__ import annotations

from typing import Literal, get_args

EngineName = Literal["auto", "native", "mjx", "mjx_warp", "warp"]
"""A physics engine; `auto` chooses the faster one here. `mjx_warp` is `mjx` with a Warp kernel for its time steps."""
MethodName = Literal["dipn+gn", "dipn+gn+actions", "gn", "dqn+gn", "rea+dipn", "vpg", "physics+gn"]
"""A method that clears tables, named after the networks (or the physics engine) that it decides with."""
Aid = Literal["mirrors", "fingers", "border", "table", "top", "still", "memory"]
"""Small rules of ours that are in no paper and help a method to decide:

mirrors: a grasp is chosen by the lowest of its score and the scores of its mirror images, and DIPN's prediction is the
  mean over a push and its mirror image.
fingers: the score of a grasp is halved where a finger would land on something.
border: something that reaches the border of the image is taken to extend beyond, where a finger could land on it.
table: a grasp centred on empty table scores 0.
top: of the grasps that score nearly as high as the best, the one on the highest thing is made.
still: predicted motions of less than half a pixel are not drawn.
memory: the scores of grasps like one that missed are halved as long as the table looks the same around them.
"""
ALL_AIDS: tuple[Aid, ...] = get_args(Aid)
"""All aids; the default of every method."""
