"""Masks found in an RGB-D image alone: what stands on the table, cut where its colour changes. OpenCV, on the host."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Int, Real

from dipn_jax.errors import UserError
from dipn_jax.structs import ABSENT, Array
from dipn_jax.workspace import WORKSPACE

TABLE_HEIGHT = 0.006
"""Height in metres below which what is coloured like the table is table; a quarter of the lowest object."""
SAME_COLOR = 22
"""Levels of 255 by which each channel of one object may differ from its median; palettes differ by more."""
MIN_REGION_PIXELS = 30
"""Size in pixels (120 mm^2) below which a region is a fragment of its neighbour."""
_BRIDGED_PIXELS = 40  # pixels over which a hidden part is bridged: the widest object above
_FRAGMENT_PIXELS = 4  # pixels over which a fragment goes to a neighbour
_MOST_REGIONS = 200  # regions of one image, after which the rest is left to _fill


def segment(height: Real[Array, "*_"], color: Real[Array, "*_"], *, slots: int) -> Int[np.ndarray, "224 224"]:
    """Find the instance masks of one image.

    Args:
      height: `[224, 224]` metres above the table.
      color: `[224, 224, 3]` RGB in [0, 1].
      slots: most masks wanted.

    Returns:
      0 for the largest mask, 1 for the next, ..., ABSENT on the table and where there are more
      than `slots`. Objects of one colour that touch are one mask.

    Raises:
      UserError: another shape, or values that are not finite.
    """
    height, color = np.asarray(height, np.float32), np.asarray(color, np.float32)
    side = WORKSPACE.pixels
    if height.shape != (side, side) or color.shape != (side, side, 3):
        raise UserError(
            f"image of height {height.shape} and colour {color.shape}: want {(side, side)} and {(side, side, 3)}; "
            "crop it to the workspace at 2 mm a pixel"
        )
    if not (np.isfinite(height).all() and np.isfinite(color).all()):
        raise UserError("image: heights or colours that are not finite; fill holes in the depth first")
    smooth = cv2.medianBlur(height, 3)
    image = cv2.bilateralFilter(np.round(np.clip(color, 0, 1) * 255).astype(np.uint8), 5, 40, 2)
    foreground = (smooth > TABLE_HEIGHT) | _off_table(image, smooth)
    regions = _regions(image, foreground)
    regions = _join(regions, image, smooth)
    return _fill(regions, foreground, slots)


def _off_table(image: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the low pixels that do not have the table's colour: the foot of a slope."""
    low = height <= TABLE_HEIGHT
    if not low.any():
        return low
    table = np.median(image[low], 0)
    same = cv2.inRange(image, np.ceil(table - SAME_COLOR), np.floor(table + SAME_COLOR))
    return low & (same == 0)


def _regions(image: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    """Label connected areas of one colour with 1, 2, ..., each grown from the middle of what is left; 0 elsewhere."""
    regions = np.zeros(foreground.shape, np.int32)
    left = foreground.astype(np.uint8)
    for number in range(1, _MOST_REGIONS):
        depth = cv2.distanceTransform(np.pad(left, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        row, col = np.unravel_index(int(depth.argmax()), depth.shape)
        if depth[row, col] < 1.5:  # nothing left but lines
            break
        closed = np.pad(1 - left, 1, constant_values=1).astype(np.uint8)  # 1: not to be entered
        flags = 4 | cv2.FLOODFILL_FIXED_RANGE | cv2.FLOODFILL_MASK_ONLY | (2 << 8)
        level = (SAME_COLOR,) * 3
        cv2.floodFill(image, closed, (int(col), int(row)), (0, 0, 0), level, level, flags)
        filled = closed[1:-1, 1:-1] == 2
        left[filled] = 0
        if filled.sum() >= MIN_REGION_PIXELS:
            regions[filled] = number
    return regions


def _join(regions: np.ndarray, image: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Merge regions of one colour where only something higher lies between them: they are one object."""
    numbers = [n for n in np.unique(regions) if n]
    mean = {n: np.median(image[regions == n], 0) for n in numbers}
    boxes = {n: _box(regions == n) for n in numbers}
    for i, a in enumerate(numbers):
        for b in numbers[i + 1 :]:
            if a not in boxes or b not in boxes or _apart(boxes[a], boxes[b]) > _BRIDGED_PIXELS + 2:
                continue  # + 2: OpenCV's distances are up to 2 % too short
            around = _around(boxes[a], boxes[b])
            near = regions[around]
            if np.abs(mean[a] - mean[b]).max() <= SAME_COLOR / 2 and _bridged(near == a, near == b, height[around]):
                regions = np.where(regions == b, a, regions)
                boxes[a] = _box(regions == a)
                del boxes[b]
    return regions


def _box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return the first and last row, and the first and last column, of a mask that is not empty."""
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return int(rows[0]), int(rows[-1]), int(cols[0]), int(cols[-1])


def _apart(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> float:
    """Return by how many pixels two boxes are apart; 0 where they overlap."""
    down = max(one[0] - other[1], other[0] - one[1], 0)
    right = max(one[2] - other[3], other[2] - one[3], 0)
    return float(np.hypot(down, right))


def _around(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest box around two boxes."""
    rows, cols = (min(one[0], other[0]), max(one[1], other[1])), (min(one[2], other[2]), max(one[3], other[3]))
    return slice(rows[0], rows[1] + 1), slice(cols[0], cols[1] + 1)


def _bridged(first: np.ndarray, second: np.ndarray, height: np.ndarray) -> bool:
    """Return whether the shortest line between two masks is short and passes under something higher than both."""
    far, nearest = cv2.distanceTransformWithLabels(
        (~first).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    row, col = np.unravel_index(int(np.where(second, far, np.inf).argmin()), far.shape)
    if far[row, col] > _BRIDGED_PIXELS:
        return False
    rows, cols = np.nonzero(first & (nearest == nearest[row, col]))
    t = np.linspace(0, 1, int(far[row, col]) + 2)[1:-1]
    line = height[np.round(row + t * (rows[0] - row)).astype(int), np.round(col + t * (cols[0] - col)).astype(int)]
    ends = max(np.median(height[first]), np.median(height[second]))
    return bool((line > ends - 0.002).mean() > 0.9)


def _fill(regions: np.ndarray, foreground: np.ndarray, slots: int) -> np.ndarray:
    """Number the labels by size and give the rest of the foreground to the neighbouring regions."""
    far, nearest = cv2.distanceTransformWithLabels(
        (regions == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, np.int32)
    owner[nearest[regions > 0]] = regions[regions > 0]
    full = np.where(foreground & (far <= _FRAGMENT_PIXELS), owner[nearest], 0)
    numbers, sizes = np.unique(full[full > 0], return_counts=True)
    order = numbers[np.argsort(-sizes, kind="stable")][:slots]
    label = np.full(full.max() + 1, ABSENT, np.int32)
    label[order] = np.arange(len(order))
    return label[full]


def match(found: Int[Array, "H W"], true: Int[Array, "H W"], *, slots: int) -> Int[np.ndarray, " {slots}"]:
    """Assign found masks to true ones: the pair with the greatest IoU first, each mask once.

    Args:
      found: labels.
      true: labels.
      slots: labels are below.

    Returns:
      Found label of each true one, ABSENT where none overlaps.
    """
    pair = np.zeros((slots + 1, slots + 1))
    np.add.at(pair, (np.asarray(true).ravel(), np.asarray(found).ravel()), 1)  # ABSENT is the last row and column
    both = pair[:slots, :slots]
    either = pair.sum(1)[:slots, None] + pair.sum(0)[None, :slots] - both
    iou = both / np.maximum(either, 1)
    result = np.full(slots, ABSENT)
    for _ in range(slots):
        i, j = np.unravel_index(int(iou.argmax()), iou.shape)
        if iou[i, j] <= 0:
            break
        result[i] = j
        iou[i], iou[:, j] = 0, 0
    return result


def segment_as(
    height: Real[Array, "224 224"], color: Real[Array, "224 224 3"], true: Int[Array, "224 224"], *, slots: int
) -> tuple[Int[np.ndarray, "224 224"], Bool[np.ndarray, " {slots}"]]:
    """Find masks in one image, numbered as the objects that they overlap most; the rest take the numbers left over.

    For training and measuring: a network is shown what the segmenter found, and it is known which object that is.

    Args:
      height: metres above the table.
      color: RGB in [0, 1].
      true: labels.
      slots: number of object slots.

    Returns:
      Labels, and which numbers are a mask of the object of that number.
    """
    found = segment(height, color, slots=slots)
    matched = match(found, true, slots=slots)
    renumbered = np.full(slots + 1, ABSENT, np.int32)  # the last: no segment
    taken = np.flatnonzero(matched != ABSENT)
    renumbered[matched[taken]] = taken
    rest = np.setdiff1d(np.arange(slots), matched[taken])
    renumbered[rest] = np.setdiff1d(np.arange(slots), taken)
    return renumbered[found], matched != ABSENT
