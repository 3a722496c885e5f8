"""Train GN, or score an image with it, in one framework, in a process of its own.

`python -m benchmarks.grasp_worker FRAMEWORK PRESET train|score FILE.npz [PRECISION]`: `images [B, W, W, 4]`,
`pixel [B, 2]` and `success [B]`, or `image [224, 224, 4]`, are in the file. See `benchmarks.worker` for what it reads
and answers.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from benchmarks import worker
from benchmarks.worker import FLOAT32, Step
from dipn_jax.networks.grasp import GraspConfig


def jax_step(preset: str, work: str, arrays: dict[str, np.ndarray], precision: str = FLOAT32) -> tuple[Step, int]:
    """Return one step of SGD with momentum, or all scores of an image, in JAX; and the number of parameters."""
    import jax
    import jax.numpy as jnp
    from dipn_jax.train.precision import compute_in
    from flax import nnx

    from dipn_jax.networks import losses
    from dipn_jax.planning import scorers
    from dipn_jax.storage import checkpoint

    model: Any = checkpoint.build("grasp", GraspConfig(preset=preset))
    compute_in(model, precision)
    if work == "score":
        model.eval()
        parameters = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))
        scorer, image = jax.jit(scorers.unaided_scorer(model)), jnp.asarray(arrays["image"])[None]
        return lambda: scorer(image).block_until_ready(), parameters
    images, pixel, success = (jnp.asarray(arrays[name]) for name in ("images", "pixel", "success"))

    def loss(network: Any) -> Any:
        logits = network(images)[jnp.arange(len(images)), pixel[:, 0], pixel[:, 1]]
        return losses.score_loss(logits, success, jnp.ones_like(success))

    return worker.sgd(model, loss)


def torch_step(preset: str, work: str, arrays: dict[str, np.ndarray], precision: str = FLOAT32) -> tuple[Step, int]:
    """Return the same step in PyTorch."""
    import torch

    from benchmarks import torch_grasp

    device = worker.torch_device()
    kind: Any = {"paper": torch_grasp.Paper, "compact": torch_grasp.Compact}[preset]
    made = kind(GraspConfig(preset=preset)).to(device)
    parameters = sum(each.numel() for each in made.parameters())
    if work == "score":
        made.eval()
        image = torch.from_numpy(arrays["image"].transpose(2, 0, 1).copy()).to(device)

        def score() -> None:
            with torch.inference_mode():
                torch_grasp.score(made, image)
            worker.wait_for(device)

        return score, parameters
    images = torch.from_numpy(arrays["images"].transpose(0, 3, 1, 2).copy()).to(device)
    row, col = torch.from_numpy(arrays["pixel"].T.copy()).long().to(device)
    success = torch.from_numpy(arrays["success"]).to(device)

    def loss() -> Any:
        logits = made(images)[torch.arange(len(images)), row, col]
        return torch.nn.functional.binary_cross_entropy_with_logits(logits, success)

    run = worker.torch_sgd(made, loss, device=device, precision=precision)
    return run, sum(each.numel() for each in made.parameters())


def main() -> None:
    """Run a worker."""
    framework, preset, work, file, *precision = sys.argv[1:]
    with np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
    worker.serve(*{"jax": jax_step, "torch": torch_step}[framework](preset, work, arrays, *precision))


if __name__ == "__main__":
    main()
