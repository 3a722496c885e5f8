"""Contacts of hulls by XLA and by the Warp kernel, compared with MuJoCo C and with one another."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import search_kernel
from object_sizes import SIZES

from dipn_jax import geometry
from dipn_jax.physics import colliders, mjx, prisms
from dipn_jax.structs import Scene
from dipn_jax.world import model, shapes

pytestmark = pytest.mark.slow
DEPTH_TOLERANCE = 1e-4
"""Metres of contact depth; `colliders.FACE_PREFERENCE` is 0.05 mm of it. Measured: 1e-8 on these pairs."""
DEEPEST = 0.003
"""Metres: deeper than any contact of an episode. Far deeper, clipping a face can cut off the deepest corner."""
ROUNDING = 2e-6
"""Metres between the kernel and XLA, of depths and of positions: float32 at a metre from the origin."""
CLIPPED = 5e-5
"""Metres that a contact may be outside a hull: MJX clips by planes whose normals are as long as an edge."""
PAIRS = 400


def _random_pairs(count: int) -> tuple[Scene, np.ndarray]:
    """Return pairs of objects of all classes that overlap a little or nearly; the first also cuts the table."""
    keys = jax.random.split(jax.random.key(0), 3)
    shape = np.stack([np.arange(count) % 5, (np.arange(count) // 5) % 5], -1).astype(np.int32)
    size = np.array([[SIZES[shapes.CLASSES[c]] for c in row] for row in shape], np.float32)
    quat = np.asarray(jax.vmap(jax.vmap(geometry.random_quat))(jax.random.split(keys[0], (count, 2))))
    direction = np.asarray(jax.random.normal(keys[1], (count, 3)))
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    gap = np.asarray(jax.random.uniform(keys[2], (count, 1), minval=0.035, maxval=0.055))
    position = np.stack([np.zeros((count, 3)), direction * gap], 1) + np.array([0.0, 0.0, 0.025])
    full = np.full(shape.shape, 0.35, np.float32)
    return Scene(shape, size, np.zeros_like(size), full, full), np.concatenate([position, quat], -1).astype(np.float32)


@jax.jit
def _depths_by_xla(scene: Scene, poses: jax.Array) -> tuple[Any, Any, tuple[jax.Array, jax.Array]]:
    """Return the hulls `[B, 2, P]`, their radii, and what `_depths` returns."""
    parts = jax.vmap(jax.vmap(prisms.parts))(scene.shape, scene.size)
    turn = geometry.quat_to_matrix(poses[..., 3:])
    pos = poses[..., None, :3] + jnp.einsum("bnij,bnpj->bnpi", turn, parts.center)
    mat = jnp.broadcast_to(turn[:, :, None], (*pos.shape, 3))
    size = jnp.broadcast_to(parts.alive[..., None], pos.shape).astype(jnp.float32)
    hulls = colliders.ConvexInfo(pos, mat, size, **vars(parts.mesh))
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[:, i], hulls) for i in (0, 1))
    each = jax.vmap(jax.vmap(colliders.convex_prism, (None, 0)), (0, None))
    plane = colliders.GeomInfo(jnp.zeros(3), jnp.eye(3), jnp.zeros(3))
    table = jax.vmap(jax.vmap(colliders.plane_prism, (None, 0)), (None, 0))(plane, first)
    return hulls, parts.radius, (jax.vmap(each)(first, second)[0].min(-1), table[0].min(-1))


def _depths(scene: Scene, poses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, by XLA and by the kernel, least distances between parts `[B, P, P]` and of the first object to the table.

    They are 1 where the parts are apart.
    """
    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):  # as in the engine
        hulls, radius, by_xla = jax.device_get(_depths_by_xla(scene, poses))
    batch, count = len(poses), shapes.CONVEX_PARTS
    flat = jax.tree.map(lambda leaf: leaf.reshape(2 * batch * count, *leaf.shape[3:]), hulls)
    hull = np.arange(2 * batch * count).reshape(batch, 2, count)
    pairs = np.stack(np.broadcast_arrays(hull[:, 0, :, None], hull[:, 1, None]), -1).reshape(-1, 2)
    low = np.stack(np.broadcast_arrays(2 * batch * count, hull[:, 0]), -1).reshape(-1, 2)
    more = jax.tree.map(lambda leaf: np.concatenate([leaf, np.zeros_like(leaf[:1])]), flat)
    more.mat[-1] = np.eye(3)
    arrays = more.vert, more.face_normal, np.append(radius.ravel(), 0), more.pos, more.mat
    between, table = (
        search_kernel.contacts(*arrays, which, planes=planes)[0].min(-1)
        for which, planes in ((pairs, False), (low, True))
    )
    return [by_xla, (between.reshape(batch, count, count), table.reshape(batch, count))]


def test_contact_depths_agree_with_mujoco_c() -> None:
    scene, poses = _random_pairs(100)
    both = _depths(scene, poses)
    touching = 0
    for b in range(len(poses)):
        one = jax.tree.map(lambda leaf, b=b: leaf[b], scene)
        spec = mujoco.MjModel.from_xml_string(model.mjcf(one, config=mjx.DEFAULTS))
        data = mujoco.MjData(spec)
        data.qpos[:] = np.concatenate([[0, 0, 2, 0, 0, 0], poses[b].reshape(-1)])
        mujoco.mj_forward(spec, data)
        for i, j in np.argwhere(shapes.CORNERS_USED[one.shape[0]][:, None] * shapes.CORNERS_USED[one.shape[1]] > 0):
            geoms = spec.geom(f"o0p{i}").id, spec.geom(f"o1p{j}").id
            wanted = mujoco.mj_geomDistance(spec, data, *geoms, 0.1, None)
            if -DEEPEST < wanted < -DEPTH_TOLERANCE:
                for found, _ in both:
                    assert abs(found[b, i, j] - wanted) < DEPTH_TOLERANCE, (b, i, j, found[b, i, j], wanted)
                touching += 1
            elif wanted > DEPTH_TOLERANCE:
                assert all(found[b, i, j] == colliders.APART_DISTANCE for found, _ in both)
        vertices = shapes.UNIT_VERTICES[one.shape[0]] * one.size[0]
        turn = data.body("o0").xmat.reshape(3, 3)
        used = shapes.CORNERS_USED[one.shape[0]] > 0
        low = (vertices[used] @ turn.T)[..., 2].min(-1) + poses[b, 0, 2]
        for _, table in both:
            np.testing.assert_allclose(table[b][used], np.where(low < 0, low, colliders.APART_DISTANCE), atol=1e-6)
            assert (table[b][~used] == colliders.APART_DISTANCE).all()
    assert touching > 10


def _hulls(shape: np.ndarray, size: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return one part of each object in its place, as for `colliders`, and its radius."""
    rng = np.random.default_rng(1)
    part = np.array([rng.integers((shapes.CORNERS_USED[s] > 0).sum()) for s in shape])
    parts = jax.device_get(jax.jit(jax.vmap(prisms.parts))(shape, size))
    mesh, radius = jax.tree.map(lambda leaf: leaf[np.arange(len(shape)), part], (parts.mesh, parts.radius))
    return colliders.ConvexInfo(pos, mat, np.ones_like(pos), **vars(mesh)), radius


@pytest.fixture(scope="module")
def placed() -> tuple[Any, np.ndarray, np.ndarray]:
    """Return hulls `[2 PAIRS]` of all classes that overlap, touch or are apart, their radii, and which are level."""
    rng = np.random.default_rng(0)
    each = np.arange(PAIRS)
    shape = np.stack([each % 5, each // 5 % 5], -1).ravel().astype(np.int32)
    size = rng.uniform(0.025, 0.1, (2 * PAIRS, 3))
    mat = np.linalg.qr(rng.normal(size=(2 * PAIRS, 3, 3)))[0]
    mat *= np.linalg.det(mat)[:, None, None]
    level = (each // 25 % 2 == 0).repeat(2)
    mat[level] = np.eye(3)
    way = rng.normal(size=(PAIRS, 3))
    way *= rng.uniform(0.02, 0.1, (PAIRS, 1)) / np.linalg.norm(way, axis=-1, keepdims=True)
    exactly = level[::2] & (each % 25 == 0)  # a cuboid that stands on another, within two micrometres of it
    way[exactly] = rng.uniform(-0.01, 0.01, (exactly.sum(), 3))
    way[exactly, 2] = (
        size[::2][exactly, 2] / 2 + size[1::2][exactly, 2] / 2 + np.resize([-2e-6, 0, 2e-6], exactly.sum())
    )
    pos = rng.uniform(-0.3, 0.3, (PAIRS, 1, 3)) + np.stack([np.zeros_like(way), way], 1)
    hulls, radius = _hulls(shape, *(np.float32(x) for x in (size, pos.reshape(-1, 3), mat)))
    hulls.size[20] = 0
    radius[20] = -np.inf
    return hulls, radius, level


def _arrays(hulls: Any, radius: np.ndarray, pairs: np.ndarray) -> tuple[Any, ...]:
    """Return the arguments of `search_kernel.contacts`."""
    return hulls.vert, hulls.face_normal, radius, hulls.pos, hulls.mat, pairs.astype(np.int32)


def _outside(hulls: Any, points: np.ndarray) -> np.ndarray:
    """Return how far points `[B, 4, 3]` are outside hulls `[B]`: `[B, 4]` metres, negative inside."""
    local = np.einsum("bij,bkj->bki", hulls.mat.swapaxes(1, 2), points - hulls.pos[:, None])
    return np.einsum("bfi,bkfi->bkf", hulls.face_normal, local[:, :, None] - hulls.face[:, None, :, 0]).max(-1)


def test_the_kernel_finds_the_contacts_of_xla(placed: tuple[Any, np.ndarray, np.ndarray]) -> None:
    hulls, radius, level = placed
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i::2], hulls) for i in (0, 1))
    with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
        wanted = jax.device_get(jax.jit(jax.vmap(colliders.convex_prism))(first, second))
    found = search_kernel.contacts(*_arrays(hulls, radius, np.arange(2 * PAIRS).reshape(-1, 2)))
    deepest, touches = found[0].min(-1), found[0] < 0
    np.testing.assert_allclose(deepest, wanted[0].min(-1), atol=ROUNDING)
    touching = touches.any(-1)
    edges, each = touches.sum(-1) == 1, np.arange(PAIRS)
    assert 200 < touching.sum() < 350 and edges.sum() > 50 and (touches.sum(-1) == 4).sum() > 100
    assert len(np.unique(np.stack([each % 5, each // 5 % 5])[:, touching])) == len(shapes.CLASSES)
    np.testing.assert_allclose(found[2][touching], wanted[2][touching], atol=1e-5)
    half = 0.5 * found[0][..., None] * found[2][:, :, 0]
    for hull, sign in ((first, -1), (second, 1)):
        assert _outside(hull, found[1] + sign * half)[touches].max() < CLIPPED
    alike = 0
    for b in np.flatnonzero(touching):
        ours, theirs = (x[1][b][x[0][b] < 0] for x in (found, wanted))
        apart = np.linalg.norm(ours[:, None] - theirs, axis=-1)
        same = len(ours) == len(theirs) and max(apart.min(0).max(), apart.min(1).max()) < 10 * ROUNDING
        assert same or level[2 * b], b  # between level faces there are ties
        alike += same
    assert alike > 0.85 * touching.sum()


def test_the_kernel_finds_the_contacts_of_a_plane(placed: tuple[Any, np.ndarray, np.ndarray]) -> None:
    hulls, radius, _ = placed
    pos = hulls.pos * np.float32([1, 1, 0.1])  # around a plane that slopes or is level
    hulls, count = hulls.replace(pos=pos), 2 * PAIRS
    for mat in (np.eye(3, dtype=np.float32), hulls.mat[-1]):
        plane = colliders.GeomInfo(np.float32([0.01, 0.02, 0.01]), mat, np.zeros(3, np.float32))
        with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
            wanted = jax.device_get(jax.jit(jax.vmap(colliders.plane_prism, (None, 0)))(plane, hulls))
        more = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf[:1]]), hulls)
        more.pos[-1], more.mat[-1] = plane.pos, plane.mat
        pairs = np.stack([np.full(count, count), np.arange(count)], -1)
        found = search_kernel.contacts(*_arrays(more, np.append(radius, -np.inf), pairs), planes=True)
        touches = found[0] < 0
        assert touches.any(-1).sum() > 100 and (touches.all(-1).sum() > 20 or mat[0, 0] < 1)
        np.testing.assert_allclose(found[2][touches], wanted[2][touches], atol=1e-6)
        np.testing.assert_allclose(found[0].min(-1), wanted[0].min(-1), atol=colliders.TOUCHING_HEIGHT)
        assert ((wanted[0] < 0).sum(-1) == touches.sum(-1)).mean() > 0.97, "contacts are lost"
        for got, want in zip(found[:2], wanted[:2], strict=True):
            assert (np.abs(got - want)[touches] < ROUNDING).mean() > 0.97, "all but where corners tie"


def test_boxes_are_as_deep_as_in_mujoco_c() -> None:
    rng, count = np.random.default_rng(3), 100
    size = rng.uniform(0.03, 0.08, (count, 2, 3))
    mat = np.linalg.qr(rng.normal(size=(count, 2, 3, 3)))[0]
    mat *= np.linalg.det(mat)[..., None, None]
    pos = np.zeros((count, 2, 3))
    pos[:, 1] = rng.uniform(-0.03, 0.03, (count, 3))
    pairs = np.arange(2 * count).reshape(-1, 2)
    for depth in (rng.uniform(0.0005, 0.0025, count), None):
        flat = [np.float32(x).reshape(2 * count, *x.shape[2:]) for x in (size, pos, mat)]
        found, _, frame = search_kernel.contacts(*_arrays(*_hulls(np.zeros(2 * count, np.int32), *flat), pairs))
        if depth is not None:  # move the second away from the first until it is only that deep
            pos[:, 1] += (-found.min(-1) - depth)[:, None] * frame[:, 0, 0]
    body = '<body mocap="true"><geom type="box" size="1 1 1"/></body>'
    free = '<body><freejoint/><geom type="box" size="1 1 1"/></body>'
    spec = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}{free}</worldbody></mujoco>")
    data, touching = mujoco.MjData(spec), 0
    for b in range(count):
        spec.geom_size[:] = size[b] / 2
        spec.geom_rbound[:] = np.linalg.norm(size[b] / 2, axis=-1)
        spec.geom_aabb[:, 3:] = size[b] / 2
        mujoco.mju_mat2Quat(data.mocap_quat[0], mat[b, 0].ravel())
        mujoco.mju_mat2Quat(data.qpos[3:], mat[b, 1].ravel())
        data.qpos[:3] = pos[b, 1]
        mujoco.mj_kinematics(spec, data)
        mujoco.mj_collision(spec, data)
        wanted = data.contact.dist.min(initial=colliders.APART_DISTANCE)
        if -DEEPEST < wanted < -DEPTH_TOLERANCE:
            assert abs(found[b].min() - wanted) < DEPTH_TOLERANCE, b
            touching += 1
    assert touching > 50


def test_what_is_far_dead_or_nowhere_has_finite_numbers(placed: tuple[Any, np.ndarray, np.ndarray]) -> None:
    hulls, radius, _ = placed
    pos, pairs = np.array(hulls.pos), np.array([[0, 1], [0, 2], [3, 4], [5, 5]])
    pos[0], pos[1:3], pos[3:] = 0, 10, np.nan
    pos[5], dead = 0, np.array(radius)
    dead[5] = -np.inf
    for planes in (False, True):
        found = search_kernel.contacts(*_arrays(hulls.replace(pos=pos), dead, pairs), planes=planes)
        assert (found[0] == colliders.APART_DISTANCE).all() and (found[1] == 0).all()
        np.testing.assert_array_equal(found[2], np.broadcast_to(np.eye(3), found[2].shape))


@pytest.mark.parametrize("planes", [False, True])
def test_lanes_wait_for_one_another(
    planes: bool, placed: tuple[Any, np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fibers run one after the other up to each barrier, so where one is missing they read what is not there yet."""
    import warp

    arrays = _arrays(*placed[:2], np.arange(2 * PAIRS).reshape(-1, 2))
    alone = search_kernel.contacts(*arrays, planes=planes)
    monkeypatch.setattr(warp.config, "enable_cpu_blocks", True)
    together, again = (search_kernel.contacts(*arrays, planes=planes, lanes=32) for _ in range(2))
    for ours, theirs, repeated in zip(together, alone, again, strict=True):
        np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(ours, repeated)
