"""What Huang et al. (ICRA 2021) report of their own simulation, in per cent, to stand beside our results."""

from __future__ import annotations

COLUMNS = ("completion", "grasp_success_completed", "grasp_success_all", "efficiency_completed", "efficiency_all")
"""Metrics of the numbers below, in their order."""
TABLE: dict[str, dict[str, tuple[float, ...]]] = {
    "random-30": {
        "vpg": (20.0, 69.0, 52.6, 66.3, 52.6),
        "rea+dipn": (83.3, 79.5, 77.9, 77.4, 76.3),
        "dqn+gn": (46.7, 85.2, 83.9, 83.4, 81.7),
        "dipn+gn": (83.3, 86.7, 85.2, 84.4, 83.3),
    },
    "hard": {
        "vpg": (77.7, 67.4, 60.0, 60.8, 57.6),
        "rea+dipn": (90.3, 81.5, 76.6, 64.7, 62.6),
        "dqn+gn": (86.0, 91.1, 87.1, 70.2, 67.9),
        "dipn+gn": (100.0, 93.3, 93.3, 74.4, 74.4),
    },
}
"""The paper's numbers by kind of tables and method."""
