"""Train GN, or score an image with it, in one framework, in a process of its own.

`python -m benchmarks.grasp_worker FRAMEWORK PRESET train|score FILE.npz`: `images [B, W, W, 4]` and `pixel [B, 2]` and
`success [B]`, or `image [224, 224, 4]`, are in the file. See `benchmarks.worker` for what it reads and answers.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from benchmarks import worker
from benchmarks.worker import MOMENTUM, RATE, Step
from dipn_jax.networks.grasp import GraspConfig


def jax_step(preset: str, work: str, arrays: dict[str, np.ndarray]) -> tuple[Step, int]:
    """Return one step of SGD with momentum, or all scores of an image, in JAX; and the number of parameters."""
    import jax
    import jax.numpy as jnp
    from flax import nnx

    from dipn_jax.networks import losses
    from dipn_jax.planning import scorers
    from dipn_jax.storage import checkpoint

    model: Any = checkpoint.build("grasp", GraspConfig(preset=preset))
    if work == "score":
        model.eval()
        parameters = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))
        scorer, image = jax.jit(scorers.plain_scorer(model)), jnp.asarray(arrays["image"])[None]
        return lambda: scorer(image).block_until_ready(), parameters
    images, pixel, success = (jnp.asarray(arrays[name]) for name in ("images", "pixel", "success"))

    def loss(network: Any) -> Any:
        logits = network(images)[jnp.arange(len(images)), pixel[:, 0], pixel[:, 1]]
        return losses.score_loss(logits, success, jnp.ones_like(success))

    return worker.sgd(model, loss)


def torch_step(preset: str, work: str, arrays: dict[str, np.ndarray]) -> tuple[Step, int]:
    """Return the same step in PyTorch."""
    import torch

    from benchmarks import torch_grasp
    from dipn_jax.physics import cores

    torch.set_num_threads(cores())
    made: Any = {"paper": torch_grasp.Paper, "compact": torch_grasp.Compact}[preset](GraspConfig(preset=preset))
    parameters = sum(each.numel() for each in made.parameters())
    if work == "score":
        made.eval()
        image = torch.from_numpy(arrays["image"].transpose(2, 0, 1).copy())

        def score() -> None:
            with torch.inference_mode():
                torch_grasp.score(made, image)

        return score, parameters
    images = torch.from_numpy(arrays["images"].transpose(0, 3, 1, 2).copy())
    row, col = torch.from_numpy(arrays["pixel"].T.copy()).long()
    success = torch.from_numpy(arrays["success"])
    optimizer = torch.optim.SGD(made.parameters(), RATE, MOMENTUM)

    def run() -> None:
        optimizer.zero_grad()
        logits = made(images)[torch.arange(len(images)), row, col]
        torch.nn.functional.binary_cross_entropy_with_logits(logits, success).backward()
        optimizer.step()

    return run, parameters


def main() -> None:
    """Run a worker."""
    framework, preset, work, file = sys.argv[1:]
    with np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
    worker.serve(*{"jax": jax_step, "torch": torch_step}[framework](preset, work, arrays))


if __name__ == "__main__":
    main()
