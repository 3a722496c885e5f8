import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.eval.prediction import push_errors
from dipn_jax.eval.prediction.pushes import Executed

from dipn_jax.planning import predictors
from dipn_jax.sight import render
from dipn_jax.storage import checkpoint
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import Push
from dipn_jax.world import scenes

CONFIG = scenes.fixed_count(3, spread=0.2)


@pytest.mark.slow
def test_prediction_measures_the_baselines_as_they_are(
    engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    network = {"dipn": checkpoint.load_network(runs["dipn"], network="dipn")}
    rows, films = push_errors.measured(
        network, engine, CONFIG, Partial(tmp_path, {}), scenes=6, seed=3, physics=True, segmented=True
    )
    values = push_errors.summary(rows)
    assert values["pushes"] == 6 and len(films["before"]) > 0
    # the engine with nominal mass and friction is nearer to the truth than nothing-moves
    assert values["push_error/physics/10cm/moved"] < values["push_error/static/10cm/moved"]
    assert values["push_error/static/5cm/all"] < values["push_error/static/10cm/all"]
    for key, value in values.items():
        assert np.isfinite(value), key


def test_static_is_the_difference_of_two_renders(engine: Any, settled: Any) -> None:
    seen = jax.tree.map(np.asarray, render.observe(settled.scene, settled.poses))
    truth = np.repeat(settled.poses[:, None], 3, 1)
    truth[:, 1:, 0, 0] += 0.01
    pushes = Push(np.zeros((6, 2), np.float32), np.zeros(6, np.float32), np.full(6, 0.05, np.float32))
    rows: push_errors.Rows = {}
    static = {"static": push_errors.at_distances(predictors.static_predictor)}
    executed = Executed(settled, pushes, truth, None)
    push_errors.measure(rows, executed, static, seen)
    after = executed.labels_after
    for b in range(6):
        for i in range(5):
            was, is_ = seen.label[b] == i, after[b, 0] == i
            either = (was | is_).sum()
            want = 1 - (was & is_).sum() / either if either else 0.0
            np.testing.assert_allclose(rows["static/push_error"][0][b, 0, i], want, atol=1e-6)
        assert rows["moved"][0][b, 0].tolist() == [bool((seen.label[b] == 0).any()), False, False, False, False]
