"""Names that are options of the commands: importing this imports no JAX, so that `--help` answers at once."""

from __future__ import annotations

from typing import Literal

EngineName = Literal["auto", "native", "mjx", "warp"]
"""A physics engine; `auto` chooses the faster one here."""
MethodName = Literal["dipn+gn", "rea+dipn", "dqn+gn", "vpg", "gn", "physics+gn"]
"""A method that clears tables: the networks, or the physics engine, that decide between pushing and grasping."""
