"""Patches of MuJoCo MJX that hold for the whole process, and the mark that keeps them to our own models.

MJX cannot be given another solver or other colliders, so `register` replaces functions in its modules:

- `solver.solve`, by `cone.solve`: contacts with elliptic friction cones;
- the colliders of meshes with planes, boxes and meshes, by `colliders.collide`.

Every replacement looks at the model first. A model that was not made from our MJCF (`world.model.mjcf`) is passed on to
MJX's own function, so other users of MJX in the same process get the results that they would get without us.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from mujoco.mjx._src import collision_driver, solver
from mujoco.mjx._src.types import GeomType

from dipn_jax.errors import UserError
from dipn_jax.physics import colliders, cone
from dipn_jax.world import model

_PATCHED_PAIRS = tuple((kind, GeomType.MESH) for kind in (GeomType.PLANE, GeomType.BOX, GeomType.MESH))
"""Types of geoms whose colliders are replaced."""


def register() -> None:
    """Patch MJX in this process; a second call changes nothing.

    Raises:
      UserError: this version of MJX makes room for another number of contacts a pair than `colliders` finds.
    """
    table = collision_driver._COLLISION_FUNC
    for types in _PATCHED_PAIRS:
        if not hasattr(table[types], "upstream"):
            table[types] = _collider(table[types])
    if not hasattr(solver.solve, "upstream"):
        solver.solve = _solver(solver.solve)


def is_ours(m: Any) -> bool:
    """Return whether an MJX model was made from our MJCF, which holds a custom number called `model.MARK`."""
    return any(m.names[start:].split(b"\0", 1)[0] == model.MARK.encode() for start in m.name_numericadr)


def _solver(upstream: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of `solver.solve`, which uses `upstream` for foreign models and unsupported settings."""

    def solve(m: Any, d: Any) -> Any:
        if not (is_ours(m) and cone.is_supported(m, d)):
            return upstream(m, d)
        return cone.solve(m, d)

    solve.upstream = upstream  # type: ignore[attr-defined]
    return solve


def _collider(upstream: Callable[..., Any]) -> Callable[..., Any]:
    """Return a replacement of a collider, which uses `upstream` for foreign models and meshes that are not traced."""
    if upstream.ncon != colliders.CONTACTS_PER_PAIR:  # type: ignore[attr-defined]
        raise UserError(
            f"mujoco-mjx: {upstream.ncon} contacts for a pair of meshes, "  # type: ignore[attr-defined]
            f"want {colliders.CONTACTS_PER_PAIR}; install the version in constraints.txt"
        )

    def collide(m: Any, d: Any, key: Any, geom: jax.Array) -> Any:
        if is_ours(m) and colliders.is_traced(m, key):
            return colliders.collide(m, d, key, geom)
        return upstream(m, d, key, geom)

    collide.ncon = upstream.ncon  # type: ignore[attr-defined]  # MJX reads it
    collide.upstream = upstream  # type: ignore[attr-defined]
    return collide
