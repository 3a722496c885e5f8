"""The body of the `compact` DIPN: it follows a push two centimetres at a time, like a simulator with learnt forces.

An object is described by the outline of its mask: the support function h(phi), how far it reaches in each of a set of
directions. Turning an object shifts that function; two convex outlines are apart by the largest of
(c_j - c_i) . phi - h_i(phi) - h_j(phi + pi), so the network need not learn geometry, only what contact does.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Bool, Float

from dipn_jax.networks import push_frame, resnet
from dipn_jax.networks.push_frame import OUTLINE_DIRECTIONS, PushInput, View
from dipn_jax.structs import Array
from dipn_jax.workspace import GRIPPER, PUSH_STEPS, WORKSPACE

STEP_CENTIMETRES = 2
"""Centimetres of a step; the network returns the motion of each of them."""
FOLDED_SAMPLES = 4
"""Samples of a crop, along a side, that are folded into the channels of one."""
CENTIMETRE = 0.01
"""Metres."""
LEAST_GAP = -0.04
"""Metres: gaps between outlines that are smaller are cut off to it, because no deeper overlap occurs within a step."""
LARGEST_GAP = 0.06
"""Metres: gaps between outlines that are larger are cut off to it, because they do not matter within a step."""
GAP_SCALE = 100
"""Factor of gaps (metres) before they go into the network, so that they are numbers of about 1."""
OUTLINE_SCALE = 20
"""Factor of outlines (metres) before they go into the network, so that they are numbers of about 1."""
PLACE_SCALE = 10
"""Factor of positions (metres) before they go into the network, so that they are numbers of about 1."""
MOTION_SCALE = 2.0
"""Factor of the network's output: pixels and degrees of a typical centimetre of motion."""
_NORMALS = push_frame.directions()
"""Unit vectors of the directions in which outlines are known."""
GRIPPER_REACH = (np.abs(_NORMALS) @ np.array([GRIPPER.pad_width / 2, GRIPPER.push_width / 2])).astype(np.float32)
"""Support function of the closed gripper that pushes to +x `[OUTLINE_DIRECTIONS]`, metres."""


def turn(reach: Float[jax.Array, "*b D F"], angle: Float[jax.Array, "*b"]) -> Float[jax.Array, "*b D F"]:
    """Turn support functions of outlines by `angle` radians; linear between directions."""
    d = reach.shape[-2]
    back = jnp.arange(d) - angle[..., None] * (d / (2 * np.pi))
    apart = jnp.abs((back[..., :, None] - jnp.arange(d) + d / 2) % d - d / 2)
    return jnp.einsum("...km,...mf->...kf", jnp.maximum(0.0, 1 - apart), reach)


def gaps(
    offset: Float[jax.Array, "*#b 2"], first: Float[Array, "*#b D"], second: Float[jax.Array, "*#b D"]
) -> Float[jax.Array, "*b D"]:
    """Return the distance of outlines along each direction; their middles are `offset` metres apart."""
    return offset @ _NORMALS.T - first - jnp.roll(second, OUTLINE_DIRECTIONS // 2, -1)


def _near(gap: Float[jax.Array, "*b"]) -> Float[jax.Array, "*b"]:
    """Return gaps (metres) as the network gets them: cut off to what matters within a step, and scaled."""
    return jnp.clip(gap, LEAST_GAP, LARGEST_GAP) * GAP_SCALE


class Stepwise(nnx.Module):
    """Network that moves objects step by step; objects exchange messages computed from the gaps between outlines."""

    def __init__(self, view: View, width: int, features: int, rounds: int, rngs: nnx.Rngs) -> None:
        f = features
        small = (view.crop_side // FOLDED_SAMPLES + 1) // 2
        self.stem = resnet.conv(view.channels * FOLDED_SAMPLES**2, width, 3, rngs)
        self.block = resnet.PlainBlock(width, rngs)
        self.down = resnet.conv(width, 2 * width, 3, rngs, stride=2)
        self.code = nnx.Linear(small**2 * 2 * width, f, rngs=rngs)
        seen = 4 * OUTLINE_DIRECTIONS + 2  # outlines, gaps to the gripper, place
        self.begin = resnet.MLP(f + 2 * OUTLINE_DIRECTIONS + 2, (f, f), rngs)
        self.node = nnx.Linear(f + seen, f, rngs=rngs)
        self.first = nnx.List([nnx.Linear(f, f, rngs=rngs) for _ in range(rounds)])
        self.second = nnx.List([nnx.Linear(f, f, rngs=rngs) for _ in range(rounds)])
        self.edge = nnx.List([nnx.Linear(OUTLINE_DIRECTIONS + 2, f, rngs=rngs) for _ in range(rounds)])
        self.message = nnx.List([nnx.Linear(f, f, rngs=rngs) for _ in range(rounds)])
        self.update = nnx.List([resnet.MLP(2 * f, (f, f), rngs, linear_end=True) for _ in range(rounds)])
        self.memory = nnx.Linear(f, f, rngs=rngs)
        self.motion = resnet.MLP(f, (f, 3 * STEP_CENTIMETRES), rngs, linear_end=True)

    def __call__(self, inputs: PushInput) -> Float[jax.Array, "B N 10 3"]:
        """Return motions (pixels, degrees, push frame) after every centimetre."""
        b, n = inputs.present.shape
        outline, centers = jnp.asarray(inputs.outlines), jnp.asarray(inputs.centers)
        crops = jnp.asarray(inputs.crops)
        code = self._encode(crops.reshape(b * n, *crops.shape[2:])).reshape(b, n, -1)
        seen = [code, OUTLINE_SCALE * outline.reshape(b, n, -1), PLACE_SCALE * centers]
        hidden = self.begin(jnp.concatenate(seen, -1))
        others = jnp.asarray(inputs.present)[:, None, :, None] & ~jnp.eye(n, dtype=bool)[None, :, :, None]
        place, angle = centers, jnp.zeros((b, n))
        moved = jnp.zeros((b, n, 3))
        course = []
        for step in range(0, PUSH_STEPS, STEP_CENTIMETRES):
            reach = turn(outline, angle)
            hidden, delta = self._advance(hidden, place - np.array([step * CENTIMETRE, 0.0]), place, reach, others)
            knots = moved[:, :, None] + jnp.cumsum(delta, 2)
            course.append(knots)
            moved = knots[:, :, -1]
            place = centers + moved[..., :2] * WORKSPACE.pixel
            angle = moved[..., 2] * (np.pi / 180)
        return jnp.concatenate(course, 2)

    def _encode(self, crops: Float[jax.Array, "B C C F"]) -> Float[jax.Array, "B G"]:
        """Return features of crops."""
        x = self.block(nnx.relu(self.stem(resnet.space_to_depth(crops, FOLDED_SAMPLES))))
        x = nnx.relu(self.down(x))
        return nnx.relu(self.code(x.reshape(x.shape[0], -1)))

    def _advance(
        self,
        hidden: Float[jax.Array, "B N F"],
        ahead: Float[jax.Array, "B N 2"],
        place: Float[jax.Array, "B N 2"],
        reach: Float[jax.Array, "B N D 2"],
        others: Bool[jax.Array, "B N N 1"],
    ) -> tuple[Float[jax.Array, "B N F"], Float[jax.Array, "B N 2 3"]]:
        """Return memory and motion of each centimetre after one step.

        `ahead` are places from the gripper, `place` the same in the push frame, metres.
        """
        b, n, _ = hidden.shape
        whole, tall = reach[..., 0], reach[..., 1]
        gripper = [_near(gaps(ahead, GRIPPER_REACH, each)) for each in (whole, tall)]
        seen = [hidden, OUTLINE_SCALE * reach.reshape(b, n, -1), *gripper, PLACE_SCALE * ahead]
        state = nnx.relu(self.node(jnp.concatenate(seen, -1)))
        offset = place[:, None] - place[:, :, None]  # from the first of a pair to the second
        between = _near(gaps(offset, whole[:, :, None], whole[:, None]))
        pair = jnp.concatenate([between, PLACE_SCALE * offset], -1)
        for first, second, edge, message, update in zip(
            self.first, self.second, self.edge, self.message, self.update, strict=True
        ):
            heard = nnx.relu(first(state)[:, :, None] + second(state)[:, None] + edge(pair))
            heard = jnp.where(others, nnx.relu(message(heard)), 0.0).sum(2)
            state = state + update(jnp.concatenate([state, heard], -1))
        delta = MOTION_SCALE * self.motion(nnx.relu(state)).astype(jnp.float32).reshape(b, n, STEP_CENTIMETRES, 3)
        return hidden + jnp.tanh(self.memory(nnx.relu(state))), delta
