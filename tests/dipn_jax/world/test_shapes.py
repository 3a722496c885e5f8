import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dipn_jax.world import shapes

SIZE = np.array([0.1, 0.05, 0.04])


def _reference(index: int) -> mujoco.MjModel:
    """Return the shape as MuJoCo computes it from meshes of density 1000."""
    meshes, geoms = "", ""
    for part in range(shapes.CONVEX_PARTS):
        n = shapes.CORNERS_USED[index, part]
        if n:
            v = shapes.UNIT_VERTICES[index, part] * SIZE
            v = np.concatenate([v[:n], v[shapes.CORNERS : shapes.CORNERS + n]])
            meshes += f'<mesh name="m{part}" vertex="{" ".join(map(str, v.ravel()))}"/>'
            geoms += f'<geom type="mesh" mesh="m{part}" density="1000"/>'
    body = f"<worldbody><body><freejoint/>{geoms}</body></worldbody>"
    return mujoco.MjModel.from_xml_string(f"<mujoco><asset>{meshes}</asset>{body}</mujoco>")


@pytest.mark.parametrize("index", range(len(shapes.CLASSES)), ids=shapes.CLASSES)
def test_mass_properties_are_those_of_the_meshes(index: int) -> None:
    model = _reference(index)
    mass = 1000 * shapes.volume(np.array(index), SIZE)
    np.testing.assert_allclose(mass, model.body_mass[1], rtol=1e-6)
    np.testing.assert_allclose(model.body_ipos[1], 0, atol=1e-7)  # the frame is at the centre of mass
    inertia = shapes.inertia(jnp.array(index), jnp.array(SIZE), jnp.array(mass))
    np.testing.assert_allclose(np.sort(inertia), np.sort(model.body_inertia[1]), rtol=1e-4)


@pytest.mark.parametrize("index", range(len(shapes.CLASSES)), ids=shapes.CLASSES)
def test_half_spaces_hold_exactly_their_corners(index: int) -> None:
    hull = shapes.hull(jnp.array(index), jnp.array(SIZE))
    for part in np.flatnonzero(hull.alive):
        slack = np.asarray(hull.normals[part] @ hull.vertices[part].T - hull.offsets[part][:, None])
        assert slack.max() < 1e-7
        assert (np.abs(slack) < 1e-7).sum(1).min() >= 3, "every face touches at least three corners"
    np.testing.assert_allclose(np.linalg.norm(hull.normals[hull.alive], axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize("index", range(len(shapes.CLASSES)), ids=shapes.CLASSES)
def test_bounding_box_is_the_size(index: int) -> None:
    corners = shapes.UNIT_VERTICES[index][shapes.CORNERS_USED[index] > 0].reshape(-1, 3)
    np.testing.assert_allclose(np.ptp(corners, axis=0), 1.0, atol=1e-6)


def test_absent_slot_has_no_part() -> None:
    assert not shapes.hull(jnp.array(-1), jnp.array(SIZE)).alive.any()


def test_catalogue_fits_the_window_and_the_gripper() -> None:
    for item in shapes.CATALOGUE:
        assert np.linalg.norm(item.size_mm) <= 1000 * shapes.MAX_DIAGONAL
        assert min(item.size_mm) < 74
