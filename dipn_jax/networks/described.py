"""What each network takes and returns, in words and numbers, for programs that run its weights without this package."""

from __future__ import annotations

from typing import Any

from dipn_jax.networks import dipn, grasp, push_frame, stepwise, vpg
from dipn_jax.sight import fingers, render
from dipn_jax.workspace import GRIPPER, PUSH_STEPS, ROTATIONS, WORKSPACE

LAYOUT = (
    "float32. Maps are [batch, rows, columns, channels]; kernels of convolutions are [rows, columns, in, out] (HWIO), "
    "of dense layers [in, out]. Convolutions are cross-correlations padded with zeros by half of the kernel; batch "
    "normalization uses `mean` and `var` with an epsilon of 1e-5."
)
"""How arrays are laid out, whatever the network."""
_SIDES = {"compact": 8, "paper": 32, "vpg paper": 16}
"""Pixels of which the sides of an image have to be a multiple."""


def _array(shape: tuple[Any, ...], meaning: str) -> dict[str, Any]:
    """Return the description of one array; letters are sizes that the user chooses, the same in all arrays."""
    return {"shape": list(shape), "meaning": meaning}


def described(network: str, config: Any) -> dict[str, Any]:
    """Return `inputs`, `outputs` (arrays by name: shape, meaning with unit and frame) and `constants` of a network.

    Args:
      network: dipn, grasp or vpg.
      config: its config.
    """
    about = _dipn(config) if network == "dipn" else _scores(network, config)
    about["constants"] = {"pixel_metres": WORKSPACE.pixel, "image_pixels": WORKSPACE.pixels} | about["constants"]
    return about


def _scores(network: str, config: grasp.GraspConfig | vpg.VpgConfig) -> dict[str, Any]:
    """Describe GN, or a compared method, whose parts are networks of the same kind."""
    value = isinstance(config, vpg.VpgConfig) and config.answers == "value"
    parts = config.parts if isinstance(config, vpg.VpgConfig) else ("grasp",)
    said = {
        "grasp": "of grasps centred on each pixel that close along the rows of the image",
        "push": "of pushes that start at each pixel and go along the rows of the image, toward the last column",
    }
    what = "value" if value else "logit; the logistic function of it is the chance"
    names = {"push": "pushes", "grasp": "grasps"} if network == "vpg" else {"grasp": "grasps"}
    sides = _SIDES["vpg paper" if network == "vpg" and config.preset == "paper" else config.preset]
    image = (
        "red, green, blue in [0, 1], and height in metres above the table, of an orthographic view from straight "
        "above; rows along +y, columns along +x, turned by -angle about its centre (direction `angle` becomes that of "
        f"the columns, nearest neighbour) and padded with table to `view_pixels`; H and W are multiples of {sides}"
    )
    return {
        "inputs": {"images": _array(("B", "H", "W", 4), image)},
        "outputs": {names[part]: _array(("B", "H", "W"), f"{what} {said[part]}") for part in parts},
        "constants": {
            "input_offset": [*render.TABLE_COLOR, 0.0],
            "input_scale": list(grasp.INPUT_SCALE),
            "normalization": "(images - input_offset) / input_scale comes first",
            "view_pixels": grasp.VIEW_PIXELS,
            "cell_pixels": grasp.CELL_PIXELS,
            "angles": ROTATIONS,
            "angle_radians": "2 pi k / angles; the half of them is enough for grasps",
            "empty_height_metres": fingers.EMPTY_HEIGHT,
        },
    }


def _dipn(config: dipn.DipnConfig) -> dict[str, Any]:
    """Describe DIPN."""
    view, frame = config.view, "push frame: metres from the start of the push, which goes to +x"
    side = WORKSPACE.pixels
    crop = "mask of the object about its centre" + (
        ", masks of the others, sweep of the gripper, own height, heights of the others" if view.context else ""
    )
    inputs = {
        "crops": _array(("B", "N", view.crop_side, view.crop_side, view.channels), f"{crop}; heights in height_unit"),
        "centers": _array(("B", "N", 2), f"centres of the masks, {frame}"),
        "present": _array(("B", "N"), "bool: objects in sight"),
        "distances": _array(("B", "K"), "metres that the gripper travels"),
    }
    if view.context:
        reach = "metres from the centre to the farthest pixel in each of 32 directions from +x toward +y, push frame"
        inputs["outlines"] = _array(
            ("B", "N", push_frame.OUTLINE_DIRECTIONS, 2), f"{reach}: of the mask, and of its part above push_tip"
        )
    else:
        inputs["push_map"] = _array(("B", side, side), "1 in start_box, else 0")
        inputs["scene_map"] = _array(("B", side, side), "1 on any object, push frame, the start at start_pixel")
    motion = "dx, dy in pixels and turn in degrees after each distance, push frame; 0 for objects that are not present"
    constants: dict[str, Any] = {
        "start_pixel": list(push_frame.START_PIXEL),
        "start_box": list(push_frame.START_BOX),
        "height_unit_metres": push_frame.HEIGHT_UNIT,
        "crop_stride_pixels": view.stride,
        "push_tip_metres": GRIPPER.push_tip,
    }
    return {
        "inputs": inputs,
        "outputs": {"motions": _array(("B", "N", "K", 3), motion)},
        "constants": constants | (_stepwise() if view.context else {}),
    }


def _stepwise() -> dict[str, Any]:
    """Return the constants of the compact DIPN's body."""
    return {
        "push_steps": PUSH_STEPS,
        "extra_centimetres": dipn.EXTRA_CENTIMETRES,
        "step_centimetres": stepwise.STEP_CENTIMETRES,
        "folded_samples": stepwise.FOLDED_SAMPLES,
        "least_gap_metres": stepwise.LEAST_GAP,
        "largest_gap_metres": stepwise.LARGEST_GAP,
        "gap_scale": stepwise.GAP_SCALE,
        "outline_scale": stepwise.OUTLINE_SCALE,
        "place_scale": stepwise.PLACE_SCALE,
        "motion_scale": stepwise.MOTION_SCALE,
        "gripper_reach_metres": [float(reach) for reach in stepwise.GRIPPER_REACH],
    }
