"""Both GNs in PyTorch, layer by layer as in `dipn_jax.networks.grasp`, to compare speeds with."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.torch_push import Bottleneck
from dipn_jax.networks.grasp import CELL_PIXELS, VIEW_PIXELS, GraspConfig
from dipn_jax.workspace import ROTATIONS, WORKSPACE, grasp_angles


class Paper(nn.Module):
    """The network `grasp._PaperTrunk`."""

    def __init__(self, config: GraspConfig) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(4, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        )
        stages, features = [], 64
        for stage, count in enumerate(config.stages):
            row: list[nn.Module] = []
            for i in range(count):
                row.append(Bottleneck(features, 64 * 2**stage, 2 if stage and not i else 1))
                features = 256 * 2**stage
            stages.append(nn.Sequential(*row))
        self.stages = nn.ModuleList(stages)
        self.lateral = nn.ModuleList([nn.Conv2d(256 * 2**i, 256, 1) for i in range(4)])
        self.smooth = nn.Conv2d(256, 256, 3, 1, 1)
        self.head = nn.Sequential(
            nn.Conv2d(256, 128, 3, 1, 1), nn.BatchNorm2d(128), nn.ReLU(),
            nn.Conv2d(128, 128, 3, 1, 1), nn.BatchNorm2d(128), nn.ReLU(), nn.Upsample(scale_factor=2),
            nn.Conv2d(128, 32, 3, 1, 1), nn.BatchNorm2d(32), nn.ReLU(), nn.Dropout(0.1),
            nn.Conv2d(32, 1, 3, 1, 1), nn.Upsample(scale_factor=2),
            nn.Conv2d(1, 1, (11, 57), 1, (5, 28)), nn.ReLU(), nn.Conv2d(1, 1, (11, 57), 1, (5, 28)),
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        """Logits `[B, H, W]` of images `[B, 4, H, W]`."""
        maps, x = [], self.stem(x)
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        y = self.lateral[3](maps[3])
        for level in (2, 1, 0):
            y = self.lateral[level](maps[level]) + functional.interpolate(y, scale_factor=2.0)
        return self.head(self.smooth(y))[:, 0]


class Residual(nn.Module):
    """The block `resnet.PlainBlock`."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(features, features, 3, 1, 1), nn.ReLU(), nn.Conv2d(features, features, 3, 1, 1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """`[B, C, H, W]`."""
        return functional.relu(x + self.body(x))


class Compact(nn.Module):
    """The network `grasp._CompactTrunk`."""

    def __init__(self, config: GraspConfig) -> None:
        super().__init__()
        fine, coarse = config.width, config.coarse
        self.stem = nn.Conv2d(4 * CELL_PIXELS**2, fine, 3, 1, 1)
        self.down = nn.Conv2d(fine, coarse, 3, 2, 1)
        self.blocks = nn.Sequential(*[Residual(coarse) for _ in range(config.blocks)])
        self.up = nn.Conv2d(coarse, 4 * fine, 1)
        self.head, self.out = nn.Conv2d(fine, 2 * fine, 3, 1, 1), nn.Conv2d(2 * fine, CELL_PIXELS**2, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Logits `[B, H, W]` of images `[B, 4, H, W]`."""
        fine = functional.relu(self.stem(functional.pixel_unshuffle(x, CELL_PIXELS)))
        coarse = self.blocks(functional.relu(self.down(fine)))
        both = functional.relu(fine + functional.pixel_shuffle(self.up(coarse), 2))
        return functional.pixel_shuffle(self.out(functional.relu(self.head(both))), CELL_PIXELS)[:, 0]


def rotate(images: Tensor, angles: Tensor, size: int) -> Tensor:
    """Rotate `[R, C, H, W]` by each angle `[R]` to `[R, C, size, size]` as `geometry.rotate_map` does."""
    scale = size / images.shape[-1]
    c, s, zero = torch.cos(angles) * scale, torch.sin(angles) * scale, torch.zeros_like(angles)
    turn = torch.stack([torch.stack([c, -s, zero], -1), torch.stack([s, c, zero], -1)], 1)
    grid = functional.affine_grid(turn, [len(angles), images.shape[1], size, size], align_corners=False)
    return functional.grid_sample(images, grid, mode="nearest", align_corners=False)


def score(network: nn.Module, image: Tensor) -> Tensor:
    """Return scores `[16, 224, 224]` of an image `[4, 224, 224]` whose table is 0, as `grasp.score_image` does."""
    angles = torch.from_numpy(grasp_angles()).to(image.device)
    views = rotate(image.expand(ROTATIONS, *image.shape), angles, VIEW_PIXELS)
    return rotate(torch.sigmoid(network(views))[:, None], -angles, WORKSPACE.pixels)[:, 0]
