"""Both DIPNs in PyTorch, layer by layer as in `dipn_jax.networks`, to compare training speeds with."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from dipn_jax.networks import push_frame, stepwise
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.push_frame import OUTLINE_DIRECTIONS
from dipn_jax.workspace import PUSH_STEPS, WORKSPACE

Inputs = dict[str, Tensor]
"""The fields of `push_frame.PushInput`, `[B, ...]`; maps and crops as they are there, channels last."""


def mlp(features: int, sizes: Sequence[int], *, linear_end: bool = False) -> nn.Sequential:
    """Return the layers of `resnet.MLP`."""
    layers: list[nn.Module] = []
    for i, size in enumerate(sizes):
        layers.append(nn.Linear(features, size))
        if i + 1 < len(sizes) or not linear_end:
            layers.append(nn.ReLU())
        features = size
    return nn.Sequential(*layers)


class Bottleneck(nn.Module):
    """The block `resnet.Bottleneck`."""

    def __init__(self, features: int, width: int, stride: int) -> None:
        super().__init__()
        out = 4 * width
        self.body = nn.Sequential(
            nn.Conv2d(features, width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU(),
            nn.Conv2d(width, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU(),
            nn.Conv2d(width, out, 1, bias=False), nn.BatchNorm2d(out),
        )  # fmt: skip
        self.project: nn.Module = nn.Identity()
        if stride != 1 or features != out:
            self.project = nn.Sequential(nn.Conv2d(features, out, 1, stride, bias=False), nn.BatchNorm2d(out))

    def forward(self, x: Tensor) -> Tensor:
        """`[B, C, H, W]`."""
        return functional.relu(self.project(x) + self.body(x))


def resnet(features: int, stages: Sequence[int]) -> nn.Sequential:
    """Return the network `resnet.ResNet`, up to its last map averaged, `[B, 2048]`."""
    layers: list[nn.Module] = [
        nn.Conv2d(features, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(), nn.MaxPool2d(3, 2, 1),
    ]  # fmt: skip
    features = 64
    for stage, count in enumerate(stages):
        for i in range(count):
            layers.append(Bottleneck(features, 64 * 2**stage, 2 if stage and not i else 1))
            features = 256 * 2**stage
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())


class Paper(nn.Module):
    """The network `dipn._Paper`."""

    def __init__(self, config: DipnConfig) -> None:
        super().__init__()
        self.scene, self.scene_out = resnet(2, config.stages), nn.Linear(2048, 512)
        self.item, self.item_out = resnet(1, config.stages), nn.Linear(2048, 64)
        self.push, self.center = mlp(4, (8, 16)), mlp(2, (8, 16))
        self.direct, self.pair = mlp(96, (128, 128)), mlp(176, (128, 128, 128))
        self.motion = mlp(640, (256, 64, 32, 16, 3), linear_end=True)
        end = np.array(push_frame.push_ends(jnp.float32(PUSH_STEPS * 0.01)))
        self.register_buffer("end", torch.from_numpy(end), persistent=False)

    def forward(self, inputs: Inputs) -> Tensor:
        """Motions `[B, N, 1, 3]` after the longest push."""
        b, n = inputs["present"].shape
        scene = self.scene_out(self.scene(torch.stack([inputs["push_map"], inputs["scene_map"]], 1)))
        crop = self.item_out(self.item(inputs["crops"].flatten(0, 1).movedim(-1, 1))).unflatten(0, (b, n))
        item = torch.cat([crop, self.center(inputs["centers"] / (WORKSPACE.half / 2))], -1)
        push = self.push(self.end).expand(b, n, -1)
        pairs = [push[:, :, None].expand(-1, -1, n, -1), item[:, :, None].expand(-1, -1, n, -1),
                 item[:, None].expand(-1, n, -1, -1)]  # fmt: skip
        total = self.direct(torch.cat([push, item], -1))
        total = total + (self.pair(torch.cat(pairs, -1)) * _others(inputs["present"])).sum(2)
        return self.motion(torch.cat([scene[:, None].expand(-1, n, -1), total], -1))[:, :, None]


class Compact(nn.Module):
    """The network `stepwise.Stepwise`."""

    def __init__(self, config: DipnConfig) -> None:
        super().__init__()
        view, width, f = config.view, config.width, config.features
        small = (view.crop_side // stepwise.FOLDED_SAMPLES + 1) // 2
        self.stem = nn.Conv2d(view.channels * stepwise.FOLDED_SAMPLES**2, width, 3, 1, 1)
        self.block = nn.ModuleList([nn.Conv2d(width, width, 3, 1, 1) for _ in range(2)])
        self.down, self.code = nn.Conv2d(width, 2 * width, 3, 2, 1), nn.Linear(small**2 * 2 * width, f)
        self.begin = mlp(f + 2 * OUTLINE_DIRECTIONS + 2, (f, f))
        self.node = nn.Linear(f + 4 * OUTLINE_DIRECTIONS + 2, f)
        rounds = range(config.rounds)
        self.first, self.second, self.message = (
            nn.ModuleList([nn.Linear(f, f) for _ in rounds]) for _ in range(3)
        )  # fmt: skip
        self.edge = nn.ModuleList([nn.Linear(OUTLINE_DIRECTIONS + 2, f) for _ in rounds])
        self.update = nn.ModuleList([mlp(2 * f, (f, f), linear_end=True) for _ in rounds])
        self.memory, self.motion = nn.Linear(f, f), mlp(f, (f, 3 * stepwise.STEP_CENTIMETRES), linear_end=True)
        self.register_buffer("normals", torch.from_numpy(push_frame.directions()), persistent=False)
        self.register_buffer("gripper", torch.from_numpy(np.asarray(stepwise.GRIPPER_REACH)), persistent=False)

    def forward(self, inputs: Inputs) -> Tensor:
        """Motions `[B, N, PUSH_STEPS, 3]`."""
        b, n = inputs["present"].shape
        outline, centers = inputs["outlines"], inputs["centers"]
        folded = functional.pixel_unshuffle(inputs["crops"].flatten(0, 1).movedim(-1, 1), stepwise.FOLDED_SAMPLES)
        x = functional.relu(self.stem(folded))
        x = functional.relu(x + self.block[1](functional.relu(self.block[0](x))))
        code = functional.relu(self.code(functional.relu(self.down(x)).flatten(1))).unflatten(0, (b, n))
        hidden = self.begin(
            torch.cat([code, stepwise.OUTLINE_SCALE * outline.flatten(2), stepwise.PLACE_SCALE * centers], -1)
        )
        others = _others(inputs["present"])
        place, moved = centers, torch.zeros(b, n, 3)
        course = []
        for step in range(0, PUSH_STEPS, stepwise.STEP_CENTIMETRES):
            reach = self.turn(outline, moved[..., 2] * (np.pi / 180))
            ahead = place - torch.tensor([step * 0.01, 0.0])
            hidden, delta = self.advance(hidden, ahead, place, reach, others)
            knots = moved[:, :, None] + delta.cumsum(2)
            course.append(knots)
            moved = knots[:, :, -1]
            place = centers + moved[..., :2] * WORKSPACE.pixel
        return torch.cat(course, 2)

    def turn(self, reach: Tensor, angle: Tensor) -> Tensor:
        """Turn vectors as `stepwise.turn` does."""
        d = reach.shape[-2]
        back = torch.arange(d) - angle[..., None] * (d / (2 * np.pi))
        apart = torch.abs((back[..., :, None] - torch.arange(d) + d / 2) % d - d / 2)
        return torch.relu(1 - apart) @ reach

    def gaps(self, offset: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """Return gaps as `stepwise.gaps` does, in the network's unit."""
        gap = offset @ self.normals.T - first - torch.roll(second, OUTLINE_DIRECTIONS // 2, -1)
        return torch.clamp(gap, stepwise.LEAST_GAP, stepwise.LARGEST_GAP) * stepwise.GAP_SCALE

    def advance(
        self, hidden: Tensor, ahead: Tensor, place: Tensor, reach: Tensor, others: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Advance one step as `Stepwise._advance` does."""
        whole = reach[..., 0]
        gripper = [self.gaps(ahead, self.gripper, reach[..., k]) for k in range(2)]
        state = functional.relu(
            self.node(
                torch.cat(
                    [hidden, stepwise.OUTLINE_SCALE * reach.flatten(2), *gripper, stepwise.PLACE_SCALE * ahead], -1
                )
            )
        )
        offset = place[:, None] - place[:, :, None]
        pair = torch.cat([self.gaps(offset, whole[:, :, None], whole[:, None]), stepwise.PLACE_SCALE * offset], -1)
        for first, second, edge, message, update in zip(
            self.first, self.second, self.edge, self.message, self.update, strict=True
        ):
            heard = functional.relu(first(state)[:, :, None] + second(state)[:, None] + edge(pair))
            heard = (functional.relu(message(heard)) * others).sum(2)
            state = state + update(torch.cat([state, heard], -1))
        state = functional.relu(state)
        delta = stepwise.MOTION_SCALE * self.motion(state).unflatten(-1, (stepwise.STEP_CENTIMETRES, 3))
        return hidden + torch.tanh(self.memory(state)), delta


def _others(present: Tensor) -> Tensor:
    """Return which objects are others, `[B, N, N, 1]` float, as `dipn._others` does."""
    return (present[:, None] & ~torch.eye(present.shape[1], dtype=torch.bool))[..., None].float()
