"""The renderer: what an orthographic camera straight above sees of a scene. Pure, batched, without OpenGL.

A vertical ray meets a convex part between its highest lower plane and its lowest upper plane, so a height
map is a minimum and a maximum of affine functions of the pixel, taken in a window around each object.
Any other view (turned into a push's frame, a crop around a grasp) is a render of transformed poses.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from dipn_jax import batching, geometry
from dipn_jax.structs import ABSENT, Array, Observation, Scene
from dipn_jax.system import forking
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import shapes

WINDOW = 64
"""Pixels a side of the window that an object is drawn in; at 2 mm a pixel `shapes.MAX_DIAGONAL` fits."""
TABLE_COLOR = (0.2, 0.2, 0.2)
"""RGB of the table."""
_STEEP = 1e-6  # |n_z| below which a face is taken as vertical
_FAR = 1e3  # metres: minus this is the top of what is not there


def _bounds(
    scene: Scene, poses: Float[Array, "N 7"]
) -> tuple[Float[jax.Array, "N P F 3"], Bool[jax.Array, "N P F"], Bool[Array, "N P"]]:
    """Return affine bounds on z (constant, x, y), which of them are from above, and which parts exist."""
    hulls = jax.vmap(shapes.hull)(scene.shape, scene.size)
    rotation = geometry.quat_to_matrix(poses[:, 3:])
    with jax.default_matmul_precision("highest"):  # tenths of millimetres, which accelerators else round away
        normal = jnp.einsum("nij,npfj->npfi", rotation, hulls.normals)
        offset = hulls.offsets + jnp.einsum("npfi,ni->npf", normal, poses[:, :3])
    nz = jnp.where(jnp.abs(normal[..., 2]) < _STEEP, _STEEP, normal[..., 2])
    plane = jnp.stack([offset / nz, -normal[..., 0] / nz, -normal[..., 1] / nz], -1)
    return plane, nz > 0, hulls.alive


def _top(
    plane: Float[Array, "F 3"], above: Bool[Array, " F"], x: Float[Array, " W"], y: Float[Array, " H"]
) -> Float[jax.Array, "H W"]:
    """Return the top of a part over pixels at `x` and `y` (metres); `-_FAR` beside the part."""
    top, bottom = jnp.float32(_FAR), jnp.float32(-_FAR)
    for face in range(plane.shape[0]):
        height = plane[face, 0] + plane[face, 1] * x[None, :] + plane[face, 2] * y[:, None]
        top = jnp.where(above[face], jnp.minimum(top, height), top)
        bottom = jnp.where(above[face], bottom, jnp.maximum(bottom, height))
    return jnp.where(top >= bottom, top, -_FAR)


def _tops(
    plane: Float[Array, "P F 3"],
    above: Bool[Array, "P F"],
    alive: Bool[Array, " P"],
    x: Float[Array, " W"],
    y: Float[Array, " H"],
) -> Float[jax.Array, "H W"]:
    """Return the top of an object, as `_top`. A missing part costs nothing where scenes are not vmapped."""
    nothing = jnp.full((y.shape[0], x.shape[0]), -_FAR)
    best = nothing
    for part in range(plane.shape[0]):
        seen = jax.lax.cond(alive[part], lambda p=part: _top(plane[p], above[p], x, y), lambda: nothing)
        best = jnp.maximum(best, seen)
    return best


@functools.partial(jax.jit, static_argnames=("pixels",))
def render_depth(
    scene: Scene, poses: Float[Array, "N 7"], *, pixels: int = WORKSPACE.pixels
) -> tuple[Float[jax.Array, "{pixels} {pixels}"], Int[jax.Array, "{pixels} {pixels}"]]:
    """Render the height map and the labels of one scene.

    Args:
      scene: one scene (no batch axis).
      poses: metres and quaternions wxyz, workspace frame.
      pixels: side of the square view, centred on the workspace, 2 mm a pixel.

    Returns:
      Height in metres (0 on the table) and label (ABSENT on the table).
    """
    n = scene.shape.shape[0]
    side = min(WINDOW, pixels)
    plane, above, alive = _bounds(scene, poses)
    middle = (pixels - 1) / 2
    # about the middle of the bounding box, which the centre of mass is not
    offset = jnp.asarray(shapes.UNIT_CENTER_OF_MASS, jnp.float32)[jnp.maximum(scene.shape, 0)] * scene.size
    box = poses[:, :3] - jnp.einsum("nij,nj->ni", geometry.quat_to_matrix(poses[:, 3:]), offset)
    corner = jnp.floor(box[:, :2] / WORKSPACE.pixel + middle - side / 2 + 1).astype(jnp.int32)
    corner = jnp.clip(jnp.nan_to_num(corner), 0, pixels - side)

    def paint(i: jax.Array, maps: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        height, label = maps
        col, row = corner[i, 0], corner[i, 1]
        x = (col + jnp.arange(side) - middle) * WORKSPACE.pixel
        y = (row + jnp.arange(side) - middle) * WORKSPACE.pixel
        top = _tops(plane[i], above[i], alive[i], x, y)
        old_height = jax.lax.dynamic_slice(height, (row, col), (side, side))
        old_label = jax.lax.dynamic_slice(label, (row, col), (side, side))
        seen = top > old_height
        height = jax.lax.dynamic_update_slice(height, jnp.where(seen, top, old_height), (row, col))
        return height, jax.lax.dynamic_update_slice(label, jnp.where(seen, i, old_label), (row, col))

    start = (jnp.zeros((pixels, pixels)), jnp.full((pixels, pixels), ABSENT, jnp.int32))
    return jax.lax.fori_loop(0, n, paint, start)


@forking.guarded
@functools.partial(jax.jit, static_argnames=("pixels",))
def render(scene: Scene, poses: Float[Array, "N 7"], *, pixels: int = WORKSPACE.pixels) -> Observation:
    """Render what the camera sees of one scene; arguments as `render_depth`.

    Example:
      names, scenes, poses = dipn_jax.load_cases()
      observation = dipn_jax.render(scenes[0], poses[0])
      every = jax.vmap(dipn_jax.render)(scenes, poses)
    """
    height, label = render_depth(scene, poses, pixels=pixels)
    return Observation(height, paint_labels(label, scene.color), label, scene.shape.shape[0])


def paint_labels(label: Int[Array, "H W"], color: Float[Array, "N 3"]) -> Float[jax.Array, "H W 3"]:
    """Paint a label map with object colours (RGB in [0, 1]) and the colour of the table."""
    palette = jnp.concatenate([color, jnp.array([TABLE_COLOR])])
    return palette[jnp.where(label == ABSENT, color.shape[0], label)]


def rgbd(observation: Observation) -> Float[jax.Array, "*b H W 4"]:
    """Return the image that networks see: RGB in [0, 1] and height in metres."""
    return jnp.concatenate([observation.color, observation.height[..., None]], -1)


def observe(scene: Scene, poses: Float[Array, "B N 7"]) -> Observation:
    """Render observations `[B]` of scenes `[B, N]` at poses `[B, N, 7]`, in memory on the device."""
    return batching.in_batches(_observe, scene, poses)


@jax.jit
def _observe(scene: Scene, poses: Float[Array, "B N 7"]) -> Observation:
    height, label = jax.lax.map(lambda pair: render_depth(*pair), (scene, poses))
    return Observation(height, jax.vmap(paint_labels)(label, scene.color), label, scene.shape.shape[1])
