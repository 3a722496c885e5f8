"""Score grasps where there is no JAX: GN's forward pass in NumPy, with weights that `dipn-train export` wrote."""

import json
import subprocess
import sys
import tempfile

import numpy as np
from safetensors import safe_open

path = tempfile.mkdtemp() + "/gn.safetensors"
export = f"export --run builtin --network grasp --format safetensors --out {path}"
subprocess.run([sys.executable, "-m", "dipn_jax.train.cli", *export.split()], check=True)  # JAX is only needed here
with safe_open(path, "numpy") as file:
    constants = json.loads(file.metadata()["constants"])
    weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def conv(x: np.ndarray, name: str, stride: int = 1) -> np.ndarray:
    """Convolve a map [H, W, C] with a kernel [rows, columns, in, out]."""
    kernel = weights[f"body.{name}.kernel"]
    x = np.pad(x, [(len(kernel) // 2,) * 2] * 2 + [(0, 0)])
    near = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[:2], (0, 1))[::stride, ::stride]
    return np.tensordot(near, kernel, ([3, 4, 2], [0, 1, 2])) + weights[f"body.{name}.bias"]


def unfold(x: np.ndarray, n: int) -> np.ndarray:  # spread the channels of each cell over n x n pixels
    return x.reshape(*x.shape[:2], n, n, -1).swapaxes(1, 2).reshape(len(x) * n, x.shape[1] * n, -1)


image = np.tile(np.float32(constants["input_offset"]), (320, 320, 1))  # the empty table, 2 mm a pixel
image[140:180, 180:195] = 0.9, 0.2, 0.2, 0.04  # a red block of 3 x 8 cm, 4 cm high
x = (image - constants["input_offset"]) / constants["input_scale"]
fine = np.maximum(conv(x.reshape(80, 4, 80, 4, 4).swapaxes(1, 2).reshape(80, 80, 64), "stem"), 0)
coarse = np.maximum(conv(fine, "down", 2), 0)
for block in ("blocks.0", "blocks.1"):
    coarse = np.maximum(coarse + conv(np.maximum(conv(coarse, f"{block}.first"), 0), f"{block}.second"), 0)
head = np.maximum(conv(np.maximum(fine + unfold(conv(coarse, "up"), 2), 0), "head"), 0)
scores = 1 / (1 + np.exp(-unfold(conv(head, "out"), 4)[..., 0]))
print("best grasp that closes along the rows: (row, column)", np.argwhere(scores == scores.max())[0], scores.max())
