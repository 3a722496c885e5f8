"""Meshes that are scaled templates, against those that MuJoCo makes of the same corners."""

from typing import Any

import mujoco
import numpy as np
import pytest

from dipn_jax.engine import PhysicsConfig
from dipn_jax.physics import warp_model
from dipn_jax.structs import ABSENT, Scene
from dipn_jax.world import shapes

SIZES = 20


@pytest.fixture(scope="module", params=range(len(shapes.CLASSES)), ids=shapes.CLASSES)
def made(request: pytest.FixtureRequest) -> Any:
    """Return scenes of two objects of a class and no object, with their meshes, and MuJoCo's model of all meshes."""
    rng, shape = np.random.default_rng(request.param), np.full((SIZES, 3), request.param)
    shape[:, 1] = ABSENT
    size = rng.uniform(0.02, 0.1, (SIZES, 3, 3)).astype(np.float32)
    scenes = Scene(shape, size, np.ones_like(size), *np.full((2, SIZES, 3), 0.5, np.float32))
    kind, bounds = warp_model.kinds(scenes), np.repeat(size, shapes.CONVEX_PARTS, 1)
    spec = mujoco.MjSpec()
    for b, m in np.argwhere(kind >= 0):
        rings = shapes.UNIT_VERTICES[warp_model.KINDS[kind[b, m]]] * bounds[b, m].astype(float)
        rings = rings.reshape(2, shapes.CORNERS, 3)[:, : shapes.CORNERS_USED[warp_model.KINDS[kind[b, m]]]]
        spec.add_mesh(name=f"{b} {m}", uservert=rings.ravel())
    empty = warp_model.compiled(3, PhysicsConfig(), mujoco.mjtJacobian.mjJAC_SPARSE)
    meshes = warp_model.mesh_fields(kind, bounds)
    return kind, meshes, warp_model.scene_fields(empty, scenes, kind, bounds), spec.compile()


def _part(fields: Any, i: int) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the corners of mesh i, and of each face the normal and the corners in order, as MuJoCo reads them."""
    start = fields["mesh_vertadr"][i]
    corners = fields["mesh_vert"][start : start + fields["mesh_vertnum"][i]]
    faces = []
    for face in fields["mesh_polyadr"][i] + np.arange(fields["mesh_polynum"][i]):
        at = fields["mesh_polyvertadr"][face]
        around = fields["mesh_polyvert"][at : at + fields["mesh_polyvertnum"][face]]
        faces.append((fields["mesh_polynormal"][face], corners[around]))
    return corners, faces


def _in_order(rows: np.ndarray) -> np.ndarray:
    return rows[np.lexsort(np.round(rows, 5).T)]


def test_corners_and_faces_are_those_that_mujoco_makes(made: Any) -> None:
    kind, meshes, rows, reference = made
    theirs = {name: getattr(reference, name) for name in (*meshes, "mesh_vert")}
    for b, m in np.argwhere(kind >= 0):
        k = reference.mesh(f"{b} {m}").id
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, reference.mesh_quat[k])
        turn, place = turn.reshape(3, 3), reference.mesh_pos[k]
        geom = rows["geom_pos"].shape[1] - kind.shape[1] + m
        np.testing.assert_allclose(rows["geom_pos"][b, geom], place, atol=1e-6)
        np.testing.assert_array_equal(rows["geom_quat"][b, geom], [1, 0, 0, 0])
        (corners, faces), (their_corners, their_faces) = _part(meshes, b * kind.shape[1] + m), _part(theirs, k)
        corners, their_corners = corners + place, their_corners @ turn.T + place
        np.testing.assert_allclose(_in_order(corners), _in_order(their_corners), atol=1e-6)
        wanted = [np.concatenate([turn @ n, np.mean(c @ turn.T + place, 0)]) for n, c in their_faces]
        found = [np.concatenate([n, np.mean(c + place, 0)]) for n, c in faces]
        np.testing.assert_allclose(_in_order(np.array(found)), _in_order(np.array(wanted)), atol=2e-6)
        np.testing.assert_allclose(rows["geom_rbound"][b, geom], np.linalg.norm(corners - place, axis=-1).max())
        box = rows["geom_aabb"][b, geom].reshape(2, 3)
        np.testing.assert_allclose(box[0] - box[1], (corners - place).min(0), atol=1e-7)
        np.testing.assert_allclose(box[0] + box[1], (corners - place).max(0), atol=1e-7)


def test_faces_turn_about_their_normals_and_meet_at_their_corners(made: Any) -> None:
    kind, meshes, _, _ = made
    for i in np.flatnonzero(kind.ravel() >= 0)[:6]:
        corners, faces = _part(meshes, i)
        for normal, around in faces:
            edges = np.roll(around, -1, 0) - around
            assert (np.cross(edges, np.roll(edges, -1, 0)) @ normal > 0).all()
        for v in range(len(corners)):
            at = meshes["mesh_polymapadr"][meshes["mesh_vertadr"][i] + v]
            count = meshes["mesh_polymapnum"][meshes["mesh_vertadr"][i] + v]
            listed = set(meshes["mesh_polymap"][at : at + count])
            assert listed == {f for f, (_, around) in enumerate(faces) if (around == corners[v]).all(-1).any()}


def test_climbing_along_the_graph_finds_the_farthest_corner(made: Any, rng: np.random.Generator) -> None:
    kind, meshes, _, _ = made
    for i in np.flatnonzero(kind.ravel() >= 0)[:6]:
        corners, _ = _part(meshes, i)
        graph = meshes["mesh_graph"][meshes["mesh_graphadr"][i] :]
        count = graph[0]
        first, names, edges = graph[2 : 2 + count], graph[2 + count : 2 + 2 * count], graph[2 + 2 * count :]
        assert sorted(names) == list(range(len(corners)))
        for direction in rng.normal(size=(20, 3)):
            value, at, best = corners[names] @ direction, -1, 0
            while best != at:
                at = best
                near = edges[first[at] :][: list(edges[first[at] :]).index(-1)]
                best = max([at, *near], key=value.__getitem__)
            assert value[at] == value.max()


def test_an_empty_slot_has_no_mesh(made: Any) -> None:
    kind, _, rows, _ = made
    mesh = rows["geom_dataid"][:SIZES, -kind.shape[1] :]
    np.testing.assert_array_equal(mesh >= 0, kind >= 0)
    assert (mesh[:, shapes.CONVEX_PARTS : 2 * shapes.CONVEX_PARTS] == -1).all()
    assert len(np.unique(mesh[mesh >= 0])) == (kind >= 0).sum()
