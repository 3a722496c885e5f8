"""DIPN's training as published: the command, its learning rate, its loss."""

import pathlib
import re
import shlex
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.train import cli, push
from dipn_jax.train.configs import TrainConfig
from dipn_jax.train.optimizers import make_optimizer, published_rate
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.networks.dipn import DipnConfig

PUBLISHED = TrainConfig(
    steps=9375, batch=8, learning_rate=1e-3, weight_decay=2e-4, optimizer="published", eval_every=250, save_every=250
)
"""50 epochs of 1,500 pushes."""


class _Still(nnx.Module):
    """A network that predicts that nothing moves."""

    def __call__(self, inputs: Any, distances: Any) -> jax.Array:
        return jnp.zeros((*inputs.present.shape, distances.shape[1], 3))


@pytest.fixture(scope="module")
def task(data: dict[str, pathlib.Path]) -> push.PushTask:
    return push.PushTask(data["push"], DipnConfig(preset="paper"), limit=None, centimetres=(5,))


def _smooth_l1(error: np.ndarray) -> np.ndarray:
    return np.where(np.abs(error) < 1, 0.5 * error**2, np.abs(error) - 0.5)


def test_the_command_on_the_help_page_trains_as_published(monkeypatch: pytest.MonkeyPatch) -> None:
    got: dict[str, Any] = {}

    def task(data: Any, network: Any, **options: Any) -> Any:
        got.update(options, preset=network.preset)
        return types.SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(push, "PushTask", task)
    monkeypatch.setattr(cli, "_fit", lambda task, config, *_, **__: got.update(config=config))
    (command,) = re.findall(r"dipn-train (push .*--preset paper(?:.*\\\n)*.*)", cli.push.__doc__ or "")
    assert console.run("test", cli.COMMANDS, shlex.split(command.replace("\\\n", " "))) == 0
    assert got["config"] == PUBLISHED and got["config"].steps * got["config"].batch == 50 * got["limit"]
    assert (got["preset"], got["centimetres"]) == ("paper", (5,))


def test_the_rate_rises_in_the_first_epoch_and_falls_to_a_tenth_after_each_third() -> None:
    rate = published_rate(PUBLISHED, examples=1500)
    steps = (0, 93.5, 187, 3124, 3125, 6249, 6250, 9374)
    want = (1e-6, 5.005e-4, 1e-3, 1e-3, 1e-4, 1e-4, 1e-5, 1e-5)
    np.testing.assert_allclose([float(rate(step)) for step in steps], want, rtol=1e-5)
    many = published_rate(PUBLISHED, examples=100_000)
    np.testing.assert_allclose([float(many(step)) for step in (500, 1000)], (5.005e-4, 1e-3), rtol=1e-5)


def test_the_optimizer_takes_the_steps_of_torch() -> None:
    """SGD of PyTorch: decay is added to the gradient, then momentum; the rate is that of the step."""
    optimizer, rate = make_optimizer(PUBLISHED, examples=24), published_rate(PUBLISHED, examples=24)
    weight, gradient = jnp.float32(2.0), jnp.float32(0.5)
    moments, want, momentum = optimizer.init(weight), 2.0, 0.0
    for step in range(4):
        update, moments = optimizer.update(gradient, moments, weight)
        weight += update
        momentum = 0.9 * momentum + 0.5 + 2e-4 * want
        want -= float(rate(step)) * momentum
        np.testing.assert_allclose(weight, want, rtol=1e-6)


def test_the_loss_is_the_mean_over_coordinates_of_pushes_that_are_not_mirrored(task: push.PushTask) -> None:
    batch, shown = task.fetch(np.arange(8)), []
    still: Any = lambda inputs, distances: shown.append(inputs) or _Still()(inputs, distances)  # noqa: E731
    counted = np.asarray(batch.inputs.present[..., None] & batch.taught)
    want = _smooth_l1(np.asarray(batch.target))[counted].mean()
    np.testing.assert_allclose(task.loss(still, batch, jax.random.key(3)), want, rtol=1e-5)
    for seen, given in zip(jax.tree.leaves(shown), jax.tree.leaves(batch.inputs), strict=True):
        np.testing.assert_array_equal(seen, given)


def test_the_learning_curve_shows_the_same_measure(task: push.PushTask) -> None:
    test = task.prepare(task.test_set.whole())
    counted = np.asarray(test.inputs.present[..., None] & test.taught)
    want = _smooth_l1(np.asarray(test.target))[counted].mean()
    np.testing.assert_allclose(task.evaluate(_Still())["held_out_loss"], want, rtol=1e-4)
