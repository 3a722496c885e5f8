import numpy as np
import pytest
from dipn_jax.eval import metrics


def test_interval_holds_the_ratio(rng: np.random.Generator) -> None:
    trials = rng.integers(1, 10, 200)
    hits = rng.binomial(trials, 0.7)
    value, low, high = metrics.ratio_interval(hits, trials)
    assert value == hits.sum() / trials.sum()
    assert low < value < high
    # as wide as the binomial's: every attempt is independent here
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.21 / trials.sum()), rel=0.15)
    assert np.isnan(metrics.ratio_interval(np.zeros(3), np.zeros(3))[0])


def test_repeats_of_a_case_are_not_tables_of_their_own(rng: np.random.Generator) -> None:
    # ten cases, thirty repeats each: a repeat is as good as its case, so there are ten numbers, not three hundred
    good = rng.uniform(size=10) < 0.6
    cases, hits, ones = np.repeat(np.arange(10), 30), np.repeat(good, 30), np.ones(300)
    _, low, high = metrics.ratio_interval(hits, ones, groups=cases)
    _, few_low, few_high = metrics.ratio_interval(good, np.ones(10))
    assert high - low == pytest.approx(few_high - few_low, rel=0.1)
    _, near_low, near_high = metrics.ratio_interval(hits, ones)
    assert high - low > 4 * (near_high - near_low), "as if all were independent"
    # repeats that are independent of their case: then they do count
    free = rng.uniform(size=300) < 0.6
    _, low, high = metrics.ratio_interval(free, ones, groups=cases)
    assert high - low < 2 * 1.96 * np.sqrt(0.24 / 300) * 1.8


def test_groups_may_have_different_sizes() -> None:
    hits, trials, names = np.array([1, 0, 0, 0]), np.array([1, 1, 1, 1]), ["a", "b", "b", "b"]
    value, low, high = metrics.ratio_interval(hits, trials, groups=names)
    assert value == 0.25 and (low, high) == (0.0, 1.0)


def test_a_difference_is_paired_by_table(rng: np.random.Generator) -> None:
    cases, ones = np.repeat(np.arange(20), 5), np.ones(100)
    hard = np.repeat(rng.uniform(size=20), 5)  # what both methods find hard
    ours, theirs = hard + 0.1, hard
    value, low, high = metrics.ratio_difference((ours, ones), (theirs, ones), cases)
    assert value == pytest.approx(0.1) and low == pytest.approx(0.1) and high == pytest.approx(0.1)
    value, low, high = metrics.ratio_difference((theirs, ones), (ours, ones), cases)
    assert value == pytest.approx(-0.1) and high == pytest.approx(-0.1)
    noise = rng.normal(0, 0.2, 100)
    value, low, high = metrics.ratio_difference((hard + noise, ones), (hard, ones), cases)
    assert low < value < high and value == pytest.approx(noise.mean())
    assert np.isnan(metrics.ratio_difference((ours, ones), (theirs, np.zeros(100)), cases)[0])
