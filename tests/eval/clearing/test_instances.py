import json
import pathlib
from typing import Any

import pytest
from dipn_jax.eval.clearing import instances

from dipn_jax.errors import UserError


def test_a_case_that_does_not_come_to_rest_is_named(engine: Any, tmp_path: pathlib.Path) -> None:
    box = {"shape": "cuboid", "size_mm": [50, 50, 50], "position_m": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    pair = [box | {"position_m": [0.18, 0]}, box | {"position_m": [0.22, 0]}]  # they overlap: one is thrown out
    path = tmp_path / "cases.json"
    path.write_text(
        json.dumps(
            {
                "cases": [
                    {"name": "a", "objects": [box]},
                    {"name": "b/..", "objects": pair},
                ]
            }
        )
    )
    with pytest.raises(UserError, match=r"case b/\.\. of .* does not come to rest"):
        instances.case_instances(engine, path, None, slots=2, repeats=1, seed=0)
    with pytest.raises(UserError, match=rf"^--names nosuch 7: not in {path}; it has a, b/\.\.$"):
        instances.case_instances(engine, path, ["nosuch", "a", "7"], slots=2, repeats=1, seed=0)
