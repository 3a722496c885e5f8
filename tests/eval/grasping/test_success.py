import pathlib
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval.grasping import success

from dipn_jax.planning import scorers
from dipn_jax.storage.resume import Partial
from dipn_jax.world import scenes

CONFIG = scenes.fixed_count(3, spread=0.2)


def test_calibration_error_of_known_scores() -> None:
    for held, error in ((1, 0.05), (0, 0.95)):
        found = success.calibration(np.full(10, 0.95), np.full(10, held))
        assert found["expected_calibration_error"] == pytest.approx(error)
        assert found["reliability/9/count"] == 10 and found["reliability/9/success"] == held


def test_grasp_evaluation_writes_what_it_promises(
    engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    scorer = scorers.load_scorer(runs["grasp"])
    values, tables = success.evaluate(scorer, engine, CONFIG, Partial(tmp_path, {}), scenes=3, seed=3, others=2)
    assert values["attempts"] == sum(table.grasps for table in tables) >= 3 and values["scenes"] == 3
    assert sum(value for key, value in values.items() if key.startswith("table/")) == 3
    assert 0 <= values["other_grasps/ceiling"] <= 1
    for name in ("gn", "random_foreground"):
        assert 0 <= values[f"grasp_success/{name}_low"] <= values[f"grasp_success/{name}"] <= 1


def test_labels_of_pretraining_mostly_agree_with_physics(engine: Any) -> None:
    found = success.label_agreement(engine, scenes.fixed_count(1), scenes=16, seed=0)
    assert found["grasps"] > 48 and 0.1 < found["positive"] < 0.9
    assert found["agree"] > 0.7
