"""Contacts of traced hulls as one GPU kernel: a warp of 32 threads a pair of geoms, and a pair that is apart ends.

XLA computes the face gaps of all pairs that the broad phase keeps, and the rest of `colliders` for the most overlapping
ones, an object's cuboid with 36 edges and 14 faces where 12 and 6 are distinct. The kernel (`narrow_kernel.py`, made of
C++ by NVIDIA Warp) leaves out repeated corners, faces and edges, stops at bounding balls or along a face where two
hulls are apart, and tests the edges of all pairs that are left. Its rules are those of `colliders`; of more than four
corners of a contact with a box it may choose other four, because the box's corners are counted from another one.

It belongs to the solver `warp` of the engine `mjx` (`PhysicsConfig.solver`); on a CPU the same source runs with one
thread. Boxes have to be among the traced hulls (`mjx_program`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int
from mujoco.mjx._src.types import GeomType

from dipn_jax.physics import blocks
from dipn_jax.physics.colliders import CONTACTS_PER_PAIR, Contacts


def contacts(
    vertices: Float[jax.Array, "G V 3"],
    normals: Float[jax.Array, "G F 3"],
    radius: Float[jax.Array, " G"],
    position: Float[jax.Array, "G 3"],
    rotation: Float[jax.Array, "G 3 3"],
    pairs: Int[jax.Array, "Q 2"],
    *,
    planes: bool = False,
) -> Contacts:
    """Return the contacts of pairs of prisms, or of planes and prisms, of one scene; under `vmap`, of many.

    Args:
      vertices: metres, in each geom's own frame, in the order of `prisms.parts`.
      normals: of their faces.
      radius: metres: ball about the origin of that frame; negative where the geom touches nothing.
      position: metres, world.
      rotation: from the geom's frame to the world's.
      pairs: the geoms of each pair.
      planes: whether the first of each pair is a plane; then nothing but its place matters.

    Returns:
      Distances `[Q, 4]` (metres; `colliders.APART_DISTANCE` where there is no contact), positions `[Q, 4, 3]` (zero
      where there is no contact) and frames `[Q, 4, 3, 3]`, world; the x axis points from the first to the second.
    """
    leaves = vertices, normals, radius, position, rotation, pairs
    count, each = len(pairs), CONTACTS_PER_PAIR
    found = _call(len(vertices), count, planes)(*(leaf.reshape(-1) for leaf in leaves))
    distance, where, frame = (leaf.reshape(count, each, -1) for leaf in found)
    return distance[..., 0], where, frame.reshape(count, each, 3, 3)


def load() -> Any:
    """Return the module of the kernel.

    Raises:
      UserError: see `blocks.load`.
    """
    blocks.load()
    from dipn_jax.physics import narrow_kernel

    return narrow_kernel


@functools.cache
def _call(geoms: int, pairs: int, planes: bool) -> Callable[..., Any]:
    """Return the kernel as a traced function of flat arrays, for those numbers of each."""
    from warp import jax_kernel

    native = load()
    kernel, size = native.kernel(), CONTACTS_PER_PAIR * pairs
    # the name of the call in a program is made of this, and its number is 0 where it is traced once: the same in every
    # process, so that XLA finds what it compiled in another
    name = f"narrow_{geoms}_{pairs}_{int(planes)}"
    kernel.func.__qualname__ = name
    call = jax_kernel(
        kernel,
        num_outputs=3,
        launch_dims=(pairs, native.LANES),
        output_dims={"distance": size, "position": 3 * size, "frame": 9 * size, name: 0},  # the last tells calls apart
        block_dim=native.LANES,
    )
    return jax.jit(lambda *leaves: call(*leaves, geoms, pairs, int(planes)))


def collide(m: Any, d: Any, kind: Any, geom: jax.Array) -> Contacts:
    """Find the contacts of pairs of geoms of one kind; arguments and result as of `colliders.collide`.

    No pair is left out: `colliders.LEFT_OUT_DISTANCE` is never returned.

    Args:
      m: MJX model whose meshes are traced; where boxes collide, their hulls are in the rows of their geoms.
      d: its data, with the geoms' places.
      kind: what the pairs are, a `FunctionKey` of MJX: a plane, a box or a mesh, and a mesh.
      geom: `[Q, 2]` geoms of each pair.
    """
    hulls = m._impl.mesh_convex[kind.data_ids[1]]
    radius = jnp.where(m.geom_size[:, 0] > 0, m.geom_rbound, -jnp.inf)
    planes = kind.types[0] == GeomType.PLANE
    found = contacts(hulls.vert, hulls.face_normal, radius, d.geom_xpos, d.geom_xmat, geom, planes=bool(planes))
    distance, position, frame = jax.tree.map(jnp.concatenate, found)
    return distance, position, frame
