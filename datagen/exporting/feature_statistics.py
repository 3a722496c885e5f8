"""Statistics of features, of an episode and joined over episodes, as LeRobot keeps them."""

from __future__ import annotations

import numpy as np

Statistics = dict[str, np.ndarray]
"""`min`, `max`, `mean` and `std` of each component, and `count [1]`."""


def of(values: np.ndarray) -> Statistics:
    """Return the statistics of the frames `[T, D]` of an episode."""
    flat = np.asarray(values, np.float64).reshape(len(values), -1)
    found = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    return found | {"count": np.array([len(values)])}


def of_pictures(values: np.ndarray) -> Statistics:
    """Return the statistics of pictures `[T, H, W, 3]`, bytes that stand for [0, 1], by colour, `[3, 1, 1]`."""
    counts = np.stack([np.bincount(values[..., channel].reshape(-1), minlength=256) for channel in range(3)])
    level = np.arange(256) / 255.0
    there, share = counts > 0, counts / counts.sum(1, keepdims=True)
    mean = share @ level
    spread = (share * (level - mean[:, None]) ** 2).sum(1)
    low, high = level[there.argmax(1)], level[255 - there[:, ::-1].argmax(1)]
    found = {"min": low, "max": high, "mean": mean, "std": np.sqrt(spread)}
    return {name: one.reshape(3, 1, 1) for name, one in found.items()} | {"count": np.array([len(values)])}


class Joined:
    """The statistics of all episodes so far."""

    def __init__(self) -> None:
        self._low: np.ndarray | float = np.inf
        self._high: np.ndarray | float = -np.inf
        self._count = 0
        self._mean: np.ndarray | float = 0.0
        self._spread: np.ndarray | float = 0.0  # sum of squares about the mean

    def add(self, one: Statistics) -> None:
        """Add the statistics of an episode."""
        count = int(one["count"][0])
        total, apart = self._count + count, one["mean"] - self._mean
        self._low, self._high = np.minimum(self._low, one["min"]), np.maximum(self._high, one["max"])
        self._spread = self._spread + count * one["std"] ** 2 + apart**2 * self._count * count / total
        self._mean = self._mean + apart * count / total
        self._count = total

    def result(self) -> Statistics:
        """Return the statistics of all episodes that were added, of which there is one at least."""
        low, high, mean = (np.asarray(value) for value in (self._low, self._high, self._mean))
        spread = np.sqrt(np.asarray(self._spread) / self._count)
        return {"min": low, "max": high, "mean": mean, "std": spread, "count": np.array([self._count])}
