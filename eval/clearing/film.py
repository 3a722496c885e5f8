"""Episodes of clearing a table, stored as states: pictures of any step are rendered when they are needed."""

from __future__ import annotations

import dataclasses
import io
import pathlib
import zlib
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from dipn_jax.errors import UserError
from dipn_jax.sight import imagine, masks, render
from dipn_jax.storage import arrays
from dipn_jax.structs import Array, Scene
from dipn_jax.system import files, typed
from dipn_jax.workspace import WORKSPACE

from .instances import Instance


@dataclasses.dataclass(frozen=True)
class Film:
    """The states and decisions of T actions on one table of N objects."""

    what: np.ndarray  # [T] str: push, grasp held, grasp missed
    shape: Int[np.ndarray, "states N"]  # which objects there are, before each action and at the end
    poses: Float[np.ndarray, "states N 7"]  # metres, wxyz
    push: Float[np.ndarray, "actions 4"]  # x, y (metres), angle (radians), distance (metres) of the best push
    grasp: Num[np.ndarray, "actions 3"]  # rotation, row, column of the best grasp
    values: Float[
        np.ndarray, "actions 3"
    ]  # its score; mean score now; gamma times the mean after the push, -inf if none
    motion: Float[
        np.ndarray, "actions masks 3"
    ]  # dx, dy (metres), dtheta (radians) predicted for the push, of each mask
    label: Int[np.ndarray, "actions H W"]  # masks that the policy decided on
    missed: Num[np.ndarray, "actions M 3"]  # grasps that it knew to have missed
    size: Float[np.ndarray, "N 3"]  # metres
    color: Float[np.ndarray, "N 3"]
    mass: Float[np.ndarray, " N"]  # kg
    friction: Float[np.ndarray, " N"]

    def before(self, step: int) -> np.ndarray:
        """Return the colours `[224, 224, 3]` before an action."""
        scene = Scene(self.shape[step], self.size, self.color, self.mass, self.friction)
        return np.asarray(render.render(scene, self.poses[step]).color)

    def pictures(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the colours `[224, 224, 3]` before an action, as predicted for the best push, and after the action."""

        def scene(at: int) -> Scene:
            return Scene(self.shape[at], self.size, self.color, self.mass, self.friction)

        seen = render.render(scene(step), self.poses[step]).replace(label=self.label[step].astype(np.int32))
        centers, _ = masks.mask_centers(seen.label, self.shape.shape[1])
        predicted = imagine.imagine(seen, centers, self.motion[step])
        after = render.render(scene(step + 1), self.poses[step + 1])
        return np.asarray(seen.color), np.asarray(predicted.color), np.asarray(after.color)


_FORM = {
    "what": arrays.Form("U", ("T",)),
    "shape": arrays.Form("iu", ("T + 1", "N")),
    "poses": arrays.Form("f", ("T + 1", "N", 7)),
    "push": arrays.Form("f", ("T", 4)),
    "grasp": arrays.Form("iuf", ("T", 3)),
    "values": arrays.Form("f", ("T", 3)),
    "motion": arrays.Form("f", ("T", "masks", 3)),
    "label": arrays.Form("iu", ("T", WORKSPACE.pixels, WORKSPACE.pixels)),
    "missed": arrays.Form("iuf", ("T", "M", 3)),
    "size": arrays.Form("f", ("N", 3)),
    "color": arrays.Form("f", ("N", 3)),
    "mass": arrays.Form("f", ("N",)),
    "friction": arrays.Form("f", ("N",)),
}
"""Arrays of a file."""


def packed(label: Int[Array, "H W"]) -> np.ndarray:
    """Return labels compressed, to be kept in an interrupted evaluation."""
    return np.frombuffer(zlib.compress(np.asarray(label, np.int8).tobytes()), np.uint8)


def unpacked(label: np.ndarray) -> np.ndarray:
    """Return the labels `[H, W]` int8 of `packed`."""
    side = WORKSPACE.pixels
    return np.frombuffer(zlib.decompress(label.tobytes()), np.int8).reshape(side, side)


def save(path: pathlib.Path, instance: Instance) -> None:
    """Write the film of a table that has ended."""
    steps: dict[str, Any] = {}
    for key in instance.film[0]:
        each = [step[key] for step in instance.film]
        steps[key] = np.stack([unpacked(one) for one in each] if key == "label" else each)
    steps["shape"] = np.concatenate([steps["shape"], instance.scene.shape[None]])
    steps["poses"] = np.concatenate([steps["poses"], instance.poses[None]])
    scene = {key: getattr(instance.scene, key) for key in ("size", "color", "mass", "friction")}
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, what=np.array(instance.did), **steps, **scene)
    files.write_atomically(path, stream.getvalue())


def load(path: pathlib.Path) -> Film:
    """Read a film.

    Raises:
      UserError: it is missing, damaged or not a film.
    """
    try:
        found = arrays.read(path, _FORM)
        if len(found["shape"]) != len(found["what"]) + 1 or not len(found["what"]):
            raise typed.Misfit(f"{len(found['what'])} actions, {len(found['shape'])} states")
    except typed.Misfit as error:
        raise UserError(
            f"{path}: missing, damaged or no film ({error}); run the dipn-eval command that writes it again"
        ) from None
    return Film(**found)
