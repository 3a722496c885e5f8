"""Names of engines and methods, options of the commands. Importing this imports no JAX, so `--help` answers at once."""

from __future__ import annotations

from typing import Literal

EngineName = Literal["auto", "native", "mjx", "warp"]
"""A physics engine; `auto` chooses the faster one here."""
MethodName = Literal["dipn+gn", "rea+dipn", "dqn+gn", "vpg", "gn", "physics+gn"]
"""A method that clears tables, named after the networks (or the physics engine) that it decides with."""
