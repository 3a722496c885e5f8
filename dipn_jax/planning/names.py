"""Names of the methods that clear tables: an option of the commands, so importing this imports no JAX."""

from __future__ import annotations

from typing import Literal

MethodName = Literal["dipn+gn", "rea+dipn", "dqn+gn", "vpg", "gn", "physics+gn"]
"""Which networks, or the physics engine itself, decide between pushing and grasping."""
