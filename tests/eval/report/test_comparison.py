import pathlib
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval.report import comparison

from dipn_jax.errors import UserError
from dipn_jax.system import files
from experiments.fuzz_parsers import PARSERS


@pytest.mark.slow
def test_the_course_of_clearing_is_the_share_left_after_each_action(cleared: Any) -> None:
    tables, out = cleared
    shares = comparison.share_left(comparison.Cleared(out), np.array([0.0, 3.0]))
    left = [(table.scene.shape >= 0).sum() / table.objects for table in tables]
    np.testing.assert_allclose(shares, [1.0, np.mean(left)])
    after = [(t.film[min(t.objects, len(t.film) - 1)]["shape"] >= 0).sum() / t.objects for t in tables]
    late = [(t.scene.shape >= 0).sum() / t.objects for t in tables]
    wanted = np.mean([a if len(t.film) > t.objects else b for t, a, b in zip(tables, after, late, strict=True)])
    np.testing.assert_allclose(comparison.share_left(comparison.Cleared(out), np.ones(1)), wanted)


def test_metrics_that_are_no_numbers_are_one_line(tmp_path: pathlib.Path) -> None:
    PARSERS["metrics"].prepare(tmp_path)
    values = files.read_json(tmp_path / "metrics.json")
    assert comparison.Cleared(tmp_path).values == values
    for wrong in ({"completion": "all"}, {"grasps": 1.5}, {"pushes": None}):
        files.write_json(tmp_path / "metrics.json", values | wrong)
        with pytest.raises(UserError, match=rf"metrics\.json: damaged, {next(iter(wrong))} is"):
            comparison.Cleared(tmp_path)
