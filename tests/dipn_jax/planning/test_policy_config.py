"""A configuration by which no method could decide is refused where it is made."""

from typing import Any

import numpy as np
import pytest

from dipn_jax.errors import UserError
from dipn_jax.planning.policy_config import PolicyConfig


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ({"candidates": 0}, "candidates 0; want a whole number above 0"),
        ({"candidates": 2.5}, "candidates 2.5; want"),
        ({"distances": ()}, "distances none; want metres"),
        ({"distances": (0.1, 10.0)}, "distances 0.1 10.0; want metres above 0 and at most 0.12"),
        ({"distances": (np.nan,)}, "distances nan; want"),
        ({"gamma": np.nan}, "gamma nan; want a finite number"),
        ({"grasp_above": np.inf}, "grasp_above inf; want"),
        ({"aids": ("mirror",)}, "aids mirror; want some of mirrors fingers"),
    ],
)
def test_what_no_method_can_decide_by_is_one_line(entries: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=f"^PolicyConfig: {says}") as refused:
        PolicyConfig(**entries)
    assert "\n" not in str(refused.value)


def test_distances_as_commands_give_them_are_accepted() -> None:
    config = PolicyConfig(candidates=np.int64(10), distances=tuple(np.arange(3, 13) * 0.01))
    np.testing.assert_allclose(config.candidate_distances(), np.arange(3, 13) * 0.01, rtol=1e-6)
