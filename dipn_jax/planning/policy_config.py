"""How a method decides, apart from its networks."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from dipn_jax.errors import UserError
from dipn_jax.names import ALL_AIDS, Aid
from dipn_jax.planning import planner
from dipn_jax.planning.planner import Rule

LONGEST_PUSH = 0.12
"""Length in metres of the longest push: simulated and learnt pushes of 10 cm, and a little beyond."""


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """How a method decides, apart from its networks.

    Example:
      config = dipn_jax.PolicyConfig(gamma=0.8, aids=())       # no aids: bare
      policy = dipn_jax.load_policy("dipn+gn", config=config)

    Raises:
      UserError: no method can use the value of a field.
    """

    candidates: int = 32  # pushes considered at a time
    distances: tuple[float, ...] = (0.10,)  # metres a push goes; of several, candidates take them in turn
    gamma: float = 0.9  # discount of a push's value
    grasp_above: float = 0.7  # grasp at once if the best score is higher
    released: bool = False  # with the clauses of DIPN's released code
    aids: tuple[Aid, ...] = ALL_AIDS  # small rules of ours; the caller gives `memory` the misses

    def __post_init__(self) -> None:
        """Raise a UserError for the first field whose value no method can use."""
        if not isinstance(self.candidates, (int, np.integer)) or self.candidates < 1:
            raise UserError(f"PolicyConfig: candidates {self.candidates!r}; want a whole number above 0")
        if not self.distances or not all(0 < distance < LONGEST_PUSH + 1e-9 for distance in self.distances):
            given = " ".join(map(str, self.distances)) or "none"
            raise UserError(f"PolicyConfig: distances {given}; want metres above 0 and at most {LONGEST_PUSH}")
        for name in ("gamma", "grasp_above"):
            if not np.isfinite(getattr(self, name)):
                raise UserError(f"PolicyConfig: {name} {getattr(self, name)!r}; want a finite number")
        if unknown := set(self.aids) - set(ALL_AIDS):
            raise UserError(f"PolicyConfig: aids {' '.join(sorted(unknown))}; want some of {' '.join(ALL_AIDS)}")

    def rule(self) -> Rule:
        """Return the rule that the planner compares by."""
        rule = planner.RELEASED if self.released else Rule()
        small, margin = "still" not in self.aids, planner.TOP_MARGIN if "top" in self.aids else 0.0
        result: Rule = rule.replace(gamma=self.gamma, grasp_above=self.grasp_above, draw_all=small, top_margin=margin)
        return result

    def candidate_distances(self) -> Float[np.ndarray, " P"]:
        """Return the distance of each candidate in metres."""
        return np.resize(np.asarray(self.distances, np.float32), self.candidates)


DEFAULT_CONFIG = PolicyConfig()
"""The rule of the paper, with all aids."""
