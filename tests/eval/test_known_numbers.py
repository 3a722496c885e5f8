"""Summaries and intervals of rows whose result is known."""

import itertools
import pathlib

import numpy as np
import pytest
from dipn_jax.eval import curves, metrics
from dipn_jax.eval.prediction import push_errors


def test_every_measure_of_a_network_has_a_curve() -> None:
    keys = ("push_error", "push_error_paper_measure", "push_position_mm", "push_angle_deg")
    rows = {f"10/0{end}/{key}": np.ones((1, 2, 1)) for end in ("", push_errors.SEGMENTED) for key in keys}
    rows |= {key: np.ones((1, 2, 1), bool) for key in ("visible", "moved")}
    measured = {key.split("/")[0] for key in push_errors.summary(rows) if "/10/0/" in key}
    assert set(curves.PUSH_MEASURES) == measured and len(measured) == 6


def test_every_measure_is_summarized_by_itself() -> None:
    networks, places = ("10/0", "10/1", "10/2", "100/0"), ("5cm/all", "5cm/moved", "10cm/all", "10cm/moved")
    each = itertools.product(curves.PUSH_MEASURES, places)
    base = {place: float(10 * i) for i, place in enumerate(each)}
    values = {
        f"{measure}/{network}/{at}": level + step
        for (measure, at), level in base.items()
        for network, step in zip(networks, (1, 2, 6, 4), strict=True)
    }
    found = curves.push_summary(values, networks)
    assert len(found) == len(base) * 2 * 3
    for (measure, at), level in base.items():
        few, many = f"{measure}/curve/10/{at}", f"{measure}/curve/100/{at}"
        assert found[f"{few}/mean"] == pytest.approx(level + 3) and found[f"{few}/std"] == pytest.approx(7**0.5)
        assert found[f"{many}/mean"] == pytest.approx(level + 4) and found[f"{many}/std"] == 0
        assert (found[f"{few}/seeds"], found[f"{many}/seeds"]) == (3, 1)


def test_grasps_are_summarized_at_each_number_of_them() -> None:
    found = curves.grasp_summary({"with": {50: [0.2, 0.4], 100: [0.5]}, "without": {50: [0.1, 0.1, 0.4]}})
    rows = {"with/50": (0.3, 0.02**0.5, 2), "with/100": (0.5, 0, 1), "without/50": (0.2, 0.03**0.5, 3)}
    for place, wanted in rows.items():
        assert tuple(found[f"online/{place}/{key}"] for key in ("mean", "std", "seeds")) == pytest.approx(wanted)
    assert len(found) == 9


def test_a_ratio_is_of_sums_and_its_interval_is_over_instances() -> None:
    assert metrics.ratio_interval(np.array([1, 0]), np.array([1, 3])) == pytest.approx((0.25, 0.0, 1.0))
    assert metrics.ratio_interval(np.array([1, 2, 3]), np.array([2, 4, 6])) == pytest.approx((0.5, 0.5, 0.5))
    # an instance without trials changes nothing; a resample without any is left out
    assert metrics.ratio_interval(np.array([3, 0]), np.array([4, 0])) == pytest.approx((0.75, 0.75, 0.75))
    # 64 instances of which half hit: the mean of that many coins, 95 % of the time within 1.96 x 1/16
    value, low, high = metrics.ratio_interval(np.arange(64) % 2, np.ones(64))
    assert value == 0.5 and (low, high) == pytest.approx((0.5 - 1.96 / 16, 0.5 + 1.96 / 16), abs=0.02)


def test_what_has_no_number_is_written_as_null(tmp_path: pathlib.Path) -> None:
    values = {"a": float("nan"), "b": float("inf"), "c": 0.5, "d": 3, "e": 0.0}
    metrics.write(tmp_path, values, settings={"seed": 1})
    assert metrics.read(tmp_path) == {"a": None, "b": None, "c": 0.5, "d": 3, "e": 0.0}
    assert "NaN" not in (tmp_path / "metrics.json").read_text()
