import pathlib
import re
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


def test_the_table_has_the_measures_of_the_first_page_and_the_paper_those_that_it_reports(
    tmp_path: pathlib.Path,
) -> None:
    PARSERS["film"].prepare(tmp_path)
    values = files.read_json(tmp_path / "metrics.json")
    files.write_json(tmp_path / "metrics.json", values | {"grasps_that_held": 0.125})
    results, _ = comparison.results_and_causes([comparison.Cleared(tmp_path)])
    head, row, *others = [re.findall(r"<t[hd]>(.*?)</t[hd]>", line) for line in results.split("<tr>")[1:]]
    ours = dict(zip(head, row, strict=True))
    assert ours["grasps that held %"].startswith("12.5 [") and ours["efficiency all %"].startswith("150.0 [")
    theirs = {line[0]: dict(zip(head, line, strict=True)) for line in others}["dipn+gn, the paper"]
    assert (theirs["grasps that held %"], theirs["grasp success all %"], theirs["efficiency all %"]) == (
        "",
        "93.3",
        "74.4",
    )
