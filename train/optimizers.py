"""Optimizers and schedules of learning rates."""

from __future__ import annotations

import optax

from dipn_jax.errors import UserError

from .configs import BaselineConfig, OnlineConfig, TrainConfig

LONGEST_RISE = 1000
"""Steps that the rate of `published_rate` rises at most. Source: DIPN's released code."""


def published_rate(config: TrainConfig, *, examples: int) -> optax.Schedule:
    """Return the learning rate of a step as DIPN's released code plans it.

    It rises from a thousandth during the first epoch (or LONGEST_RISE steps), and falls to a tenth after each third of
    the run. That code compares whole epochs with thirds, so that there it falls only if their number is a multiple of
    three, which the 50 of its README is not; the thirds are our reading.
    """
    rise = min(LONGEST_RISE, max(1, -(-examples // config.batch) - 1))
    thirds = {-(-k * config.steps // 3): 0.1 for k in (1, 2)}
    risen = optax.linear_schedule(config.learning_rate / 1000, config.learning_rate, rise)
    fallen = optax.piecewise_constant_schedule(1.0, thirds)
    return lambda step: risen(step) * fallen(step)


def make_optimizer(config: TrainConfig, *, examples: int = 0) -> optax.GradientTransformation:
    """Return the optimizer of a run on this number of examples, with its schedule."""
    if config.optimizer in ("sgd", "published"):
        constant = config.optimizer == "sgd"
        rate = config.learning_rate if constant else published_rate(config, examples=examples)
        return optax.chain(optax.add_decayed_weights(config.weight_decay), optax.sgd(rate, momentum=0.9))
    if config.optimizer == "adamw":
        warm = min(100, config.steps // 10 + 1)
        rate = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warm, max(config.steps, warm + 1))
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=config.weight_decay))
    raise UserError(f"--optimizer {config.optimizer}: want adamw, sgd or published")


def constant_adamw(config: OnlineConfig | BaselineConfig) -> optax.GradientTransformation:
    """The optimizer of a run that learns while it acts: AdamW with a constant rate."""
    adamw = optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
    return optax.chain(optax.clip_by_global_norm(1.0), adamw)
