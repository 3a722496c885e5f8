"""The cost that MuJoCo's documentation gives for contacts with elliptic cones, in NumPy."""

from typing import Any

import numpy as np


def cost(p: Any, a: np.ndarray) -> float:
    """Return the cost of quadratic rows, and of each contact by zone: top (free), bottom (quadratic), middle (cone).

    Args:
      p: a `cone._Problem` of NumPy arrays.
      a: acceleration `[V]`.
    """
    x = p.rows @ a - p.goal
    total = (a - p.free) @ p.mass @ (a - p.free) / 2 + (np.where(p.always | (x < 0), p.weight, 0) * x**2).sum() / 2
    for i in range(len(p.mu)):
        u = p.cones[i] @ a - p.cone_goal[i]
        normal, tangent, mu = u[0], np.linalg.norm(u[1:]), p.mu[i]
        if mu * normal + tangent <= 0:
            total += p.stiffness[i] * (normal**2 + tangent**2) / 2
        elif normal < mu * tangent:
            total += p.stiffness[i] / (1 + mu**2) * (normal - mu * tangent) ** 2 / 2
    return float(total)


def exact(p: Any) -> Any:
    """Return the problem in double precision."""
    return type(p)(**{name: leaf.astype(float) if leaf.dtype != bool else leaf for name, leaf in vars(p).items()})
