"""One table of `dipn-eval clear` as a moving picture: docs/clearing.gif.

    dipn-eval clear --push-net builtin --grasp-net builtin --cases hard --names 01 --out results/picture
    python -m experiments.moving_picture --out results/picture

Every action is simulated again from the state that the evaluation kept, this time with the instants in between.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import matplotlib

matplotlib.use("agg")
import cv2
import jax
import matplotlib.pyplot as plt
import numpy as np
import tyro
from dipn_jax.eval import drawing
from dipn_jax.eval.clearing import film
from matplotlib.patches import Polygon
from PIL import Image

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.physics import make_engine
from dipn_jax.planning import candidates
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.sight import render
from dipn_jax.structs import Push, Scene, Trajectory
from dipn_jax.workspace import GRIPPER, WORKSPACE
from dipn_jax.world import primitives

SIZE = (7.4, 4.15)
"""Width and height of the picture in inches."""
DPI = 100
"""Resolution in pixels per inch."""
PERIOD = 0.1
"""Simulated seconds between frames."""
FRAME_SECONDS = 0.12
"""Seconds for which a frame is shown."""
HOLD_FRAMES = 8
"""Frames for which a decision is shown before it is executed, and the result after a push."""
THRESHOLD = PolicyConfig().grasp_above
"""Score above which `dipn-eval clear` grasps at once by default."""
BACKGROUND = "#1b1b1b"
"""Colour of the background."""
COLORS = 96
"""Number of colours in the GIF's palette."""
LIGHT = np.array([-0.5, 0.6, 0.9])
"""Direction to the light that shades slopes; workspace frame."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """The content of one picture."""

    picture: np.ndarray  # [224, 224, 3] the camera's image
    title: str
    note: str = ""  # shown where there is no imagined image
    imagined: np.ndarray | None = None  # [224, 224, 3] the image that DIPN predicted
    gripper: np.ndarray | None = None  # [5] x, y, tip height (metres), yaw (radians), inner gap (metres)
    push: np.ndarray | None = None  # [4] x, y (metres), angle (radians), distance (metres): drawn as an arrow
    grasp: np.ndarray | None = None  # [3] rotation, row, column: drawn as jaws


def shaded(color: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the colours `[H, W, 3]` of a height map `[H, W]` (metres), lit from one side, with dark edges."""
    smooth = cv2.GaussianBlur(height, (3, 3), 0)
    down, across = np.gradient(smooth, WORKSPACE.pixel)
    normal = np.stack([-across, -down, np.ones_like(height)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = normal @ (LIGHT / np.linalg.norm(LIGHT))
    return np.clip(color * (0.55 + 0.6 * np.clip(light, 0, 1))[..., None], 0, 1)


def seen(scene: Scene, poses: np.ndarray) -> np.ndarray:
    """Return the shaded image `[224, 224, 3]` of a scene `[N]` at poses `[N, 7]`."""
    image = render.render(scene, poses)
    return shaded(np.asarray(image.color), np.asarray(image.height))


def scene_at(shown: film.Film, step: int) -> Scene:
    """Return the scene before action `step` of a film."""
    return Scene(shown.shape[step], shown.size, shown.color, shown.mass, shown.friction)


def trajectory(shown: film.Film, step: int) -> Trajectory:
    """Return the gripper's set points `[1, K]` of action `step`."""
    if shown.what[step] == "push":
        push = shown.push[step : step + 1]
        return primitives.push_trajectory(Push(push[:, :2], push[:, 2], push[:, 3]))
    height = render.render(scene_at(shown, step), shown.poses[step]).height
    grasp = candidates.grasp_at(shown.grasp[step], height)
    return primitives.grasp_trajectory(jax.tree.map(lambda leaf: np.asarray(leaf)[None], grasp))


def simulated(shown: film.Film, step: int, engine: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return poses `[S, N, 7]` and gripper `[S, 5]` every PERIOD of action `step`."""
    path = trajectory(shown, step)
    times = np.arange(0.0, float(np.asarray(path.time)[0, -1]), PERIOD)
    scene = structs.stack([scene_at(shown, step)])
    rollout = engine.simulate(scene, shown.poses[step][None], path, times[1:])
    return np.asarray(rollout.poses)[0], np.asarray(rollout.gripper)[0]


def frames(shown: film.Film, engine: Any) -> Iterator[Frame]:
    """Return the whole film of T actions."""
    for step, what in enumerate(shown.what):
        scene, score = scene_at(shown, step), shown.values[step, 0]
        before, push = seen(scene, shown.poses[step]), what == "push"
        said = f"{step + 1}. {what.split()[0]}    (best grasp scores {score:.2f})"
        note = "" if push else "grasp at once:\nno push is imagined" if score > THRESHOLD else "no push promises more"
        about = (said, note, shown.pictures(step)[1] if push else None)
        action = {"push": shown.push[step]} if push else {"grasp": shown.grasp[step]}
        yield from [Frame(before, *about, **action)] * (HOLD_FRAMES if push else HOLD_FRAMES // 2)
        for poses, gripper in zip(*simulated(shown, step, engine), strict=True):
            yield Frame(seen(scene, poses), *about, gripper)
        if push:
            yield from [Frame(seen(scene, shown.poses[step + 1]), *about)] * HOLD_FRAMES
    yield from [Frame(seen(scene_at(shown, -1), shown.poses[-1]), "cleared")] * HOLD_FRAMES


def fingers(axis: Any, gripper: np.ndarray) -> None:
    """Draw the two fingers; the higher they are, the fainter."""
    x, y, height, yaw, gap = gripper
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    alpha = float(np.clip(1.1 - 4 * height, 0.15, 0.95))
    for side in (-1, 1):
        near, far = (side * (gap / 2 + reach) * along for reach in (0.0, GRIPPER.thickness))
        half = GRIPPER.pad_width / 2 * across
        corners = np.array([x, y]) + np.array([near - half, near + half, far + half, far - half])
        axis.add_patch(Polygon(corners, facecolor="white", edgecolor="black", alpha=alpha, lw=0.8))


def draw(frame: Frame) -> Image.Image:
    """Draw one picture."""
    figure, (left, right) = plt.subplots(1, 2, figsize=SIZE, dpi=DPI, facecolor=BACKGROUND)
    figure.subplots_adjust(0.015, 0.02, 0.985, 0.87, 0.03)
    drawing.show(left, smooth(frame.picture))
    left.set_title(frame.title, color="white", fontsize=10, loc="left")
    if frame.push is not None:
        drawing.arrow(left, frame.push)
    if frame.grasp is not None:
        drawing.jaws(left, frame.grasp)
    if frame.gripper is not None:
        fingers(left, frame.gripper)
    blank = np.full((2, 2, 3), 0.14)
    drawing.show(right, blank if frame.imagined is None else smooth(frame.imagined))
    if frame.imagined is not None:
        right.set_title("imagined before the push", color="white", fontsize=10, loc="left")
    else:
        right.text(0, 0, frame.note, color="#777777", fontsize=10, ha="center", va="center")
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
    plt.close(figure)
    return Image.fromarray(pixels.copy())


def smooth(picture: np.ndarray) -> np.ndarray:
    """Return the picture with twice the pixels and smooth edges."""
    return np.clip(cv2.resize(picture.astype(np.float32), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 0, 1)


def save(pictures: list[Image.Image], path: pathlib.Path) -> None:
    """Write an endless GIF; all pictures share one palette, so that only changed pixels are stored."""
    few = pictures[:: max(1, len(pictures) // 12)]
    sheet = Image.fromarray(np.concatenate([np.asarray(each) for each in few]))
    palette = sheet.quantize(COLORS, dither=Image.Dither.NONE)
    flat = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=int(1000 * FRAME_SECONDS), loop=0, optimize=True)


def main(
    out: pathlib.Path = pathlib.Path("results/picture"),
    to: pathlib.Path = pathlib.Path("docs/clearing.gif"),
    table: int = 0,
) -> None:
    """Make the moving picture of one table of an evaluation.

    Args:
      out: the folder that `dipn-eval clear --out` wrote.
      to: the GIF.
      table: number of the episode.
    """
    shown = film.load(out / "episodes" / f"{table:03d}.npz")
    pictures = [draw(frame) for frame in frames(shown, make_engine("native"))]
    save(pictures, to)
    print(f"{to}: {len(pictures)} pictures, {to.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        raise SystemExit(f"error: {error}") from None
