"""Hand-placed scenes read from a case file in the format of `hard_cases.json`."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.structs import ABSENT, Scene
from dipn_jax.system import files, typed
from dipn_jax.workspace import LOWEST_TIP, WORKSPACE
from dipn_jax.world import scenes, shapes

MAX_ENTRY_NUMBER = 1e6
"""Largest number that an entry may have."""
_OBJECT = {
    "size_mm": (float,) * 3,
    "position_m": (float,) * 2,
    "quaternion_wxyz": (float,) * 4,
    "color_rgb?": (float,) * 3,
    "height_m?": typed.Maybe(float),
}
"""Form of an object, beside its shape."""
_KNOWN = ("shape", *(name.removesuffix("?") for name in _OBJECT))
"""Entries of an object."""
_CASES = {"cases": [{"name?": object, "objects": [dict]}]}
"""Form of a case file."""
_DATA = pathlib.Path(__file__).parents[1] / "data"


def hard_cases_path() -> pathlib.Path:
    """Return the path of the ten hard cases that come with the package."""
    return _DATA / "hard_cases.json"


def heldout_cases_path() -> pathlib.Path:
    """Return the path of the fifteen cases that come with the package and on which no setting was tuned."""
    return _DATA / "heldout_cases.json"


def load_cases(
    path: pathlib.Path | str | None = None, *, slots: int | None = None
) -> tuple[list[str], Scene, Float[np.ndarray, "C N 7"]]:
    """Read a case file: hand-placed scenes in the format of `hard_cases.json`.

    Example:
      names, scenes, poses = dipn_jax.load_cases()             # the ten hard tables
      names, scenes, poses = dipn_jax.load_cases("mine.json")
      observation = dipn_jax.render(scenes[0], poses[0])

    Args:
      path: JSON file with `cases`, each a name and a list of objects; by default the ten hard tables of the paper.
      slots: padded number of objects; the largest case's by default.

    Returns:
      Names, scenes and poses of C cases as placed: not settled. Density 500 kg/m^3, friction 0.35.

    Raises:
      UserError: the file is missing, is not JSON, an object in it has an unknown shape or a wrong size, or
        lies so low that the gripper cannot reach it.
    """
    path = hard_cases_path() if path is None else files.absolute(path)
    try:
        cases = typed.check(typed.parse(files.read_bytes(path)), _CASES)["cases"]
        names = [_name(case.get("name", i)) for i, case in enumerate(cases)]
    except OSError as error:
        raise UserError(
            f"case file {path}: {error.strerror}; give a JSON file in the format of {hard_cases_path().name}"
        ) from None
    except typed.Misfit as error:
        raise UserError(
            f"case file {path}: {error}; want a JSON object with a list `cases`, each with its list of `objects`"
        ) from None
    if not cases or not all(case["objects"] for case in cases):
        raise UserError(f"case file {path}: no case, or one without objects; want at least one, and one in each case")
    most = max(len(case["objects"]) for case in cases)
    n = slots or most
    if most > n:
        raise UserError(f"case file {path}: a case has {most} objects, but there are {n} slots")
    if len(set(names)) < len(names):
        raise UserError(f"case file {path}: two cases have the same name; give each its own")
    loaded = [
        _case(case["objects"], n, f"case file {path}, case {name}") for name, case in zip(names, cases, strict=True)
    ]
    scene = jax.tree.map(lambda *leaves: np.stack(leaves), *[scene for scene, _ in loaded])
    return names, scene, np.stack([p for _, p in loaded])


def _name(value: Any) -> str:
    """Return the name of a case: a text or a number."""
    return str(value) if type(value) in (int, float) else str(typed.check(value, str, at="the name of a case"))


def _case(objects: list[dict[str, Any]], n: int, where: str) -> tuple[Scene, Float[np.ndarray, "{n} 7"]]:
    shape = np.full(n, ABSENT, np.int32)
    size = np.full((n, 3), 0.05, np.float32)
    color = np.zeros((n, 3), np.float32)
    poses, tops, fallen = np.array(scenes.parked(n)), np.zeros(n), np.zeros(n)
    for i, entry in enumerate(objects):
        name = entry.get("shape")
        if name not in shapes.CLASSES:
            raise UserError(
                f"{where}, object {i}: unknown shape {typed.brief(name)!r}; want one of {', '.join(shapes.CLASSES)}"
            )
        try:
            typed.check(entry, _OBJECT)
            if unknown := [key for key in entry if key not in _KNOWN]:
                raise typed.Misfit(f"unknown entry {typed.brief(unknown[0])}, none of {', '.join(_KNOWN)}")
            size[i] = _numbers(entry["size_mm"]) / 1000
            position = _numbers(entry["position_m"])
            quat = _numbers(entry["quaternion_wxyz"])
            color[i] = _numbers(entry.get("color_rgb", shapes.COLORS_RGB[i % 10])) / 255
            height = None if entry.get("height_m") is None else float(_numbers([entry["height_m"]])[0])
        except typed.Misfit as error:
            raise UserError(
                f"{where}, object {i}: {error}; want size_mm [3], position_m [2], quaternion_wxyz [4]"
            ) from None
        if size[i].min() < 0.005 or np.linalg.norm(size[i]) > shapes.MAX_DIAGONAL:
            raise UserError(
                f"{where}, object {i}: size_mm {entry['size_mm']}; want 5 mm or more a side and a diagonal of at most "
                f"{1000 * shapes.MAX_DIAGONAL:.0f} mm"
            )
        if not (height is None or 0 < height < 1) or color[i].min() < 0 or color[i].max() > 1:
            raise UserError(f"{where}, object {i}: height_m or color_rgb is out of range; want 0 to 1 m, 0 to 255")
        if np.abs(position).max() > WORKSPACE.half or np.linalg.norm(quat) < 1e-6:
            raise UserError(
                f"{where}, object {i}: position_m {entry['position_m']} or quaternion_wxyz is out of range; want "
                f"|x|, |y| <= {WORKSPACE.half} and a non-zero quaternion"
            )
        shape[i] = shapes.CLASSES.index(name)
        quat = quat / np.linalg.norm(quat)
        rotation = np.asarray(geometry.quat_to_matrix(jnp.asarray(quat)))
        corners = shapes.UNIT_VERTICES[shape[i]][shapes.CORNERS_USED[shape[i]] > 0].reshape(-1, 3) * size[i]
        center = rotation @ (shapes.UNIT_CENTER_OF_MASS[shape[i]] * size[i])  # from the middle of the box
        resting = 0.0005 - float((corners @ rotation[2]).min())
        z = resting if height is None else height + center[2]
        poses[i] = np.concatenate([position + center[:2], [z], quat])
        tops[i] = z + float((corners @ rotation[2]).max())
        fallen[i] = tops[i] if height is None else resting + float((corners @ rotation[2]).max())
    for i in range(len(objects)):
        away = np.linalg.norm(poses[:, :2] - poses[i, :2], axis=-1)
        near = (shape >= 0) & (away < (np.linalg.norm(size, axis=-1) + np.linalg.norm(size[i])) / 2)
        top = tops[i] if near.sum() > 1 else fallen[i]  # by itself it falls onto the table
        if top <= LOWEST_TIP:
            raise UserError(
                f"{where}, object {i}: is {1000 * top:.0f} mm high as it lies, below the gripper's reach: its fingers "
                f"close {1000 * LOWEST_TIP:.0f} mm above the table; turn it up, or leave it out"
            )
    return scenes.nominal(Scene(shape, size, color, np.zeros(n), np.zeros(n))), poses


def _numbers(values: Sequence[float]) -> Float[np.ndarray, " _"]:
    """Return numbers as an array.

    Raises:
      Misfit: one of them is too large.
    """
    if max(map(abs, values)) > MAX_ENTRY_NUMBER:
        raise typed.Misfit(f"{values} has a number above {MAX_ENTRY_NUMBER:g}")
    return np.asarray(values, np.float32)
