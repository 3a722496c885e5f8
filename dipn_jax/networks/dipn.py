"""DIPN: predicts where every object goes when the gripper pushes; `paper` as published, `compact` for a CPU."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Bool, Float

from dipn_jax.errors import UserError
from dipn_jax.networks import push_frame, resnet, stepwise
from dipn_jax.networks.push_frame import PushInput, View
from dipn_jax.structs import Array
from dipn_jax.workspace import PUSH_STEPS, WORKSPACE

EXTRA_CENTIMETRES = 2
"""Centimetres that a push may go beyond those of the data."""


@dataclasses.dataclass(frozen=True)
class DipnConfig:
    """Architecture. `paper` is as published; `compact` trains on a laptop's CPU."""

    preset: str = "compact"  # or paper
    stages: tuple[int, ...] = (3, 4, 6, 3)  # paper: ResNet-50; the released code has (2, 2, 2, 2)
    width: int = 24  # compact: channels of the first stage
    features: int = 128  # compact: size of the features of an object, a scene and an interaction
    rounds: int = 2  # compact: rounds of messages between all objects

    def __post_init__(self) -> None:
        if self.preset not in ("paper", "compact"):
            raise UserError(f"push network: preset {self.preset!r}; want paper or compact")

    @property
    def view(self) -> View:
        """View of a push that the network is shown."""
        return push_frame.PAPER if self.preset == "paper" else push_frame.COMPACT


class _Paper(nnx.Module):
    """ResNet1, ResNet2 and MLP1 to MLP5, sizes as published."""

    def __init__(self, config: DipnConfig, rngs: nnx.Rngs) -> None:
        self.scene = resnet.ResNet(2, config.stages, rngs)
        self.scene_out = nnx.Linear(2048, 512, rngs=rngs)
        self.item = resnet.ResNet(1, config.stages, rngs)
        self.item_out = nnx.Linear(2048, 64, rngs=rngs)
        self.push = resnet.MLP(4, (8, 16), rngs)
        self.center = resnet.MLP(2, (8, 16), rngs)
        self.direct = resnet.MLP(16 + 80, (128, 128), rngs)
        self.pair = resnet.MLP(16 + 2 * 80, (128, 128, 128), rngs)
        self.motion = resnet.MLP(512 + 128, (256, 64, 32, 16, 3), rngs, linear_end=True)

    def __call__(self, inputs: PushInput, distances: Float[Array, "B K"]) -> Float[jax.Array, "B N K 3"]:
        b, n = inputs.present.shape
        e_scene = self.scene_out(self.scene(_maps(inputs))[-1].mean((1, 2)))
        crops, present = jnp.asarray(inputs.crops), jnp.asarray(inputs.present)
        e_crop = self.item_out(self.item(crops.reshape(b * n, *crops.shape[2:]), present.reshape(-1))[-1].mean((1, 2)))
        where = self.center(jnp.asarray(inputs.centers) / (WORKSPACE.half / 2))
        e_item = jnp.concatenate([e_crop.reshape(b, n, -1), where], -1)
        each = [self._interact(push_frame.push_ends(d), e_item, e_scene, present) for d in distances.T]
        return jnp.stack(each, 2)

    def _interact(
        self,
        ends: Float[jax.Array, "B 4"],
        e_item: Float[Array, "B N F"],
        e_scene: Float[Array, "B G"],
        present: Bool[Array, "B N"],
    ) -> Float[jax.Array, "B N 3"]:
        """Return motions by the pushes `ends`."""
        b, n, _ = e_item.shape
        e_push = self.push(ends)
        push = jnp.broadcast_to(e_push[:, None], (b, n, e_push.shape[-1]))
        direct = self.direct(jnp.concatenate([push, e_item], -1))
        pair = self.pair(jnp.concatenate([jnp.repeat(push[:, :, None], n, 2), *_pairs(e_item)], -1))
        total = direct + jnp.where(_others(present), pair, 0.0).sum(2)
        scene = jnp.broadcast_to(e_scene[:, None], (b, n, e_scene.shape[-1]))
        return self.motion(jnp.concatenate([scene, total], -1))


class _Compact(nnx.Module):
    """`Stepwise`, interpolated to any distance: one pass predicts all distances, and the loss is over all of them."""

    def __init__(self, config: DipnConfig, rngs: nnx.Rngs) -> None:
        self.steps = stepwise.Stepwise(config.view, config.width, config.features, config.rounds, rngs)

    def __call__(self, inputs: PushInput, distances: Float[Array, "B K"]) -> Float[jax.Array, "B N K 3"]:
        return _along(self.steps(inputs), distances)


def _maps(inputs: PushInput) -> Float[jax.Array, "B M M 2"]:
    """Return the maps of the push and of the scene as an image of two channels."""
    return jnp.stack([inputs.push_map, inputs.scene_map], -1)


def _pairs(items: Float[Array, "B N F"]) -> list[Float[jax.Array, "B N N F"]]:
    """Return `items` as the first and as the second of every pair."""
    n = items.shape[1]
    return [jnp.repeat(items[:, :, None], n, 2), jnp.repeat(items[:, None], n, 1)]


def _others(present: Bool[Array, "B N"]) -> Bool[Array, "B N N 1"]:
    """Return whether the second object of a pair is `present` and not the first."""
    return present[:, None, :, None] & ~jnp.eye(present.shape[1], dtype=bool)[None, :, :, None]


def _along(course: Float[Array, "B N T 3"], distances: Float[Array, "B K"]) -> Float[jax.Array, "B N K 3"]:
    """Return motions after `distances` (metres) of courses that are known after each of PUSH_STEPS centimetres.

    Beyond the last recorded centimetre objects continue as they moved in it.
    """
    last = course[:, :, -1:] - course[:, :, -2:-1]
    beyond = [course[:, :, -1:] + k * last for k in range(1, EXTRA_CENTIMETRES + 1)]
    knots = jnp.concatenate([jnp.zeros_like(last), course, *beyond], 2)
    at = jnp.clip(distances * 100, 0, PUSH_STEPS + EXTRA_CENTIMETRES)
    weight = jnp.maximum(
        0.0, 1 - jnp.abs(at[..., None] - jnp.arange(PUSH_STEPS + EXTRA_CENTIMETRES + 1))
    )  # linear interpolation
    return jnp.einsum("bks,bnsd->bnkd", weight, knots)


class DIPN(nnx.Module):
    """Deep Interaction Prediction Network (Huang et al., ICRA 2021)."""

    def __init__(self, config: DipnConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.body = (_Paper if config.preset == "paper" else _Compact)(config, rngs)

    def __call__(self, inputs: PushInput, distances: Float[Array, "B K"]) -> Float[jax.Array, "B N K 3"]:
        """Return the motions of every object after each of several distances of the same push.

        Args:
          inputs: batched.
          distances: metres, traced. `paper` was published for one distance; here the end of the push tells it the
            distance.

        Returns:
          dx, dy in pixels and dtheta in degrees, push frame; 0 for objects out of sight.
        """
        motion = self.body(inputs, distances).astype(jnp.float32)
        return jnp.where(inputs.present[..., None, None], motion, 0.0)


def symmetric(network: DIPN, inputs: PushInput, distances: Float[Array, "B K"]) -> Float[jax.Array, "B N K 3"]:
    """Return the mean of the prediction and of the mirrored prediction for the mirrored push.

    Physics knows no left and right, so both are predictions of the same motion.
    Arguments and result as `DIPN.__call__`. The published network predicts once, as published.
    """
    if network.config.preset == "paper":
        return network(inputs, distances)
    mirrored = network(push_frame.mirror(inputs), distances)
    return (network(inputs, distances) + push_frame.mirror_motion(mirrored)) / 2
