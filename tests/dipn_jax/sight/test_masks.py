import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from dipn_jax import geometry
from dipn_jax.sight import masks
from dipn_jax.structs import ABSENT
from dipn_jax.workspace import WORKSPACE


@pytest.fixture
def label(rng: np.random.Generator) -> np.ndarray:
    """Return a map of ragged masks of five objects, of which the fourth is out of sight."""
    coarse = rng.choice([ABSENT, ABSENT, 0, 1, 2, 4], (16, 16)).astype(np.int16)
    return np.asarray(cv2.resize(coarse, (224, 224), interpolation=cv2.INTER_NEAREST))


def test_contour_is_opencvs(label: np.ndarray) -> None:
    mask = label != ABSENT
    eroded = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    np.testing.assert_array_equal(masks.contour(jnp.array(mask)), mask & (eroded == 0))


def test_centroids_are_opencvs(label: np.ndarray) -> None:
    centers, area = masks.mask_centers(jnp.array(label), 5)
    for i in range(5):
        moments = cv2.moments((label == i).astype(np.uint8), binaryImage=True)
        assert area[i] == moments["m00"]
        if moments["m00"]:
            want = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
            np.testing.assert_allclose(geometry.metres_to_pixels(centers[i]), want, atol=1e-2)
    assert (np.asarray(area) > 0).tolist() == [True, True, True, False, True] and not np.asarray(centers[3]).any()


def test_the_centroid_of_a_rectangle_is_its_middle() -> None:
    label = np.full((7, 10), ABSENT)
    label[2:4, 5:8] = 0  # rows 2 and 3, columns 5, 6 and 7: the map's middle is at row 3, column 4.5
    label[6, 9] = 2
    centers, area = masks.mask_centers(jnp.array(label), 3)
    assert area.tolist() == [6, 0, 1]
    want = np.array([[1.5, -0.5], [0, 0], [4.5, 3]]) * WORKSPACE.pixel
    np.testing.assert_allclose(centers, want, rtol=1e-6)


@pytest.mark.parametrize("columns", [1, 224, 1448])
def test_rows_are_summed_exactly(columns: int) -> None:
    count, total = masks._row_sums(jnp.ones((2, columns), bool).at[0, :-1].set(False))
    assert count.tolist() == [1, columns]
    assert total.tolist() == [columns - 1, columns * (columns - 1) / 2]


def test_a_contour_has_the_pixels_with_a_neighbour_outside() -> None:
    full = np.ones((4, 5), bool)
    inside = np.zeros((4, 5), bool)
    inside[1:-1, 1:-1] = True
    np.testing.assert_array_equal(masks.contour(jnp.array(full)), ~inside)
    for row, col in np.argwhere(full):  # a hole: its neighbours are on the contour, it is not
        holed = np.ones((4, 5), bool)
        holed[row, col] = False
        near = np.zeros((4, 5), bool)
        near[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2] = True
        np.testing.assert_array_equal(masks.contour(jnp.array(holed)), holed & (near | ~inside))
