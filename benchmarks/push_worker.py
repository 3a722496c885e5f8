"""Train one network in one framework in a process of its own, so that its peak memory is its own.

`python -m benchmarks.push_worker FRAMEWORK PRESET BATCH FILE.npz [PRECISION]`: inputs `[B, ...]` and
`target [B, N, 10, 3]` are in the file. See `benchmarks.worker` for what it reads and answers.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from benchmarks import worker
from benchmarks.worker import FLOAT32, Step
from dipn_jax.workspace import PUSH_STEPS

FIELDS = ("push_map", "scene_map", "crops", "outlines", "centers", "present")
"""Inputs that are sent to PyTorch."""


def jax_step(preset: str, arrays: dict[str, np.ndarray], precision: str = FLOAT32) -> tuple[Step, int]:
    """Return one step of SGD with momentum in JAX, and the number of parameters."""
    import jax.numpy as jnp
    from dipn_jax.train.precision import compute_in

    from dipn_jax.networks import dipn, losses, push_frame
    from dipn_jax.storage import checkpoint

    inputs = push_frame.PushInput(**{name: jnp.asarray(arrays[name]) for name in FIELDS})
    model = checkpoint.build("dipn", dipn.DipnConfig(preset=preset))
    compute_in(model, precision)
    target = _target(preset, arrays["target"])
    centimetres = np.broadcast_to(np.arange(PUSH_STEPS + 1 - target.shape[2], PUSH_STEPS + 1), target.shape[:3:2])

    def loss(network: Any) -> Any:
        predicted = network(inputs, jnp.asarray(centimetres) * 0.01)
        taught = jnp.broadcast_to(inputs.present[..., None], target.shape[:3])
        return losses.motion_loss(predicted, jnp.asarray(target), taught)

    return worker.sgd(model, loss)


def torch_step(preset: str, arrays: dict[str, np.ndarray], precision: str = FLOAT32) -> tuple[Step, int]:
    """Return the same step in PyTorch."""
    import torch

    from benchmarks import torch_push
    from dipn_jax.networks.dipn import DipnConfig

    device = worker.torch_device()
    kind: Any = {"paper": torch_push.Paper, "compact": torch_push.Compact}[preset]
    made = kind(DipnConfig(preset=preset)).to(device)
    inputs = {name: torch.from_numpy(arrays[name]).to(device) for name in FIELDS}
    target = torch.from_numpy(_target(preset, arrays["target"])).to(device)
    weight = inputs["present"][..., None, None].float()

    def loss() -> Any:
        error = torch.nn.functional.smooth_l1_loss(made(inputs), target, reduction="none")
        return (error * weight).sum() / (weight.sum() * target.shape[2])

    run = worker.torch_sgd(made, loss, device=device, precision=precision)
    return run, sum(each.numel() for each in made.parameters())


def _target(preset: str, target: np.ndarray) -> np.ndarray:
    """Return the targets of a network of this preset: `paper` predicts one distance, `compact` all."""
    return target[:, :, -1:] if preset == "paper" else target


def main() -> None:
    """Run a worker."""
    framework, preset, batch, file, *precision = sys.argv[1:]
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name][: int(batch)] for name in stored}
    worker.serve(*{"jax": jax_step, "torch": torch_step}[framework](preset, arrays, *precision))


if __name__ == "__main__":
    main()
