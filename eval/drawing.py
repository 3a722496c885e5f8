"""Parts of a page: tables, pictures, and what is drawn on a picture."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Mapping
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from dipn_jax.commands import pages
from dipn_jax.system import files
from dipn_jax.workspace import WORKSPACE


def label(text: str) -> str:
    """Return a user's name for a figure: `$` begins no formula, and bytes that are no text are replaced."""
    readable = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return readable.replace("$", r"\$")


def percent(values: Mapping[str, Any], measure: str) -> str:
    """Return a share in per cent as text, with its interval if there is one."""
    value = values.get(measure)
    if value is None or not np.isfinite(value):
        return "-"
    low, high = values.get(f"{measure}_low"), values.get(f"{measure}_high")
    interval = f" [{100 * low:.0f}, {100 * high:.0f}]" if low is not None and high is not None else ""
    return f"{100 * value:.1f}{interval}"


def image(figure: Any, path: pathlib.Path) -> str:
    """Return a figure as an HTML image with its content inside; also write it to `path`."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, bbox_inches="tight")
    plt.close(figure)
    files.write_atomically(path, stream.getvalue())
    return pages.picture(stream.getvalue(), path.stem)


def write(figure: Any, path: pathlib.Path) -> None:
    """Write a figure as a PNG file, whole or not at all."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130)
    plt.close(figure)
    files.write_atomically(path, stream.getvalue())


def show(axis: Any, picture: np.ndarray, title: str = "") -> None:
    """Draw a picture `[224, 224, 3]` of the workspace, y up."""
    half = WORKSPACE.half
    axis.imshow(picture, origin="lower", extent=(-half, half, -half, half), interpolation="nearest")
    axis.set(xticks=[], yticks=[], xlim=(-half, half), ylim=(-half, half))
    axis.set_title(label(title), fontsize=9)


def arrow(axis: Any, push: np.ndarray) -> None:
    """Draw a push: x, y (metres), angle (radians), distance (metres)."""
    x, y, angle, distance = (float(v) for v in push)
    step = (distance * np.cos(angle), distance * np.sin(angle))
    axis.annotate("", (x + step[0], y + step[1]), (x, y), arrowprops={"arrowstyle": "-|>", "color": "white", "lw": 2.5})


def jaws(axis: Any, grasp: np.ndarray) -> None:
    """Draw the two fingers of a grasp: rotation, row, column."""
    angle = grasp[0] * 2 * np.pi / 16
    x, y = ((grasp[[2, 1]] + 0.5) * WORKSPACE.pixel) - WORKSPACE.half
    for side in (-1, 1):
        cx, cy = x + side * 0.047 * np.cos(angle), y + side * 0.047 * np.sin(angle)
        dx, dy = -0.012 * np.sin(angle), 0.012 * np.cos(angle)
        axis.plot([cx - dx, cx + dx], [cy - dy, cy + dy], color="white", lw=3)
    axis.plot([x], [y], "+", color="white")
