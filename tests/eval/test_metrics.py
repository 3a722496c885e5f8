from collections.abc import Sequence

import numpy as np
import pytest
from dipn_jax.eval import metrics
from scipy import stats


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
    assert high - low < 2 * 1.96 * np.sqrt(0.24 / 300) * 2.2


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


def _resampled(groups: Sequence[str], seed: int) -> list[list[int]]:
    """Return the tables of 2000 two-stage resamples, drawn by loops: groups, and then the tables of each."""
    rng = np.random.default_rng(seed)
    members = [[i for i, name in enumerate(groups) if name == group] for group in sorted(set(groups))]
    most = max(map(len, members))
    chosen = rng.integers(0, len(members), (2000, len(members)))
    uniform = rng.uniform(size=(2000, len(members), most))
    rows = []
    for which, numbers in zip(chosen, uniform, strict=True):
        drawn = [members[group] for group in which]
        rows.append(
            [own[int(u * len(own))] for own, each in zip(drawn, numbers, strict=True) for u in each[: len(own)]]
        )
    return rows


GROUPS = ["b", "a", "b", "c", "b", "a", "d", "e", "f", "g", "h", "h"]
"""Cases of unequal size, in no order; those that have a trial are six for one method, and seven for either."""
HITS, TRIALS = (
    np.array([0.9, 0, 2.3, 0.2, 0.1, 0, 0, 0, 0.6, 0.3, 0.7, 0.8]),
    np.array([1.0, 0, 3, 1, 1, 0, 0, 1, 1, 1, 2, 1]),
)
OTHERS, TRIED = (
    np.array([0.4, 0.8, 0.7, 0, 0, 0, 0, 0.3, 0.4, 0, 0.2, 0.1]),
    np.array([2.0, 1, 1, 0, 0, 0, 0, 1, 1, 0, 1, 1]),
)
"""Hits and trials of two methods: some resamples have few trials of one of them."""


@pytest.mark.parametrize("seed", [0, 5])
@pytest.mark.parametrize("groups", [GROUPS, None])
def test_resamples_are_those_of_a_loop(groups: list[str] | None, seed: int) -> None:
    rows = _resampled(groups or list("abcdefghijkl"), seed)
    found = metrics._resamples(12, groups, seed)
    assert [[i for i in row if i >= 0] for row in found.tolist()] == rows
    assert found.min() == (-1 if groups else 0)
    values = [HITS[row].sum() / TRIALS[row].sum() for row in rows if TRIALS[row].sum()]
    chosen = {"groups": groups, **({"seed": seed} if seed else {})}
    value, *ends = metrics.ratio_interval(HITS, TRIALS, **chosen)
    tail = 100 * _tail(6 if groups else 9)
    assert value == HITS.sum() / TRIALS.sum() and ends == pytest.approx(np.percentile(values, [tail, 100 - tail]))


@pytest.mark.parametrize("seed", [0, 5])
def test_a_difference_is_that_of_a_loop(seed: int) -> None:
    rows = [row for row in _resampled(GROUPS, seed) if TRIALS[row].sum() and TRIED[row].sum()]
    values = [HITS[row].sum() / TRIALS[row].sum() - OTHERS[row].sum() / TRIED[row].sum() for row in rows]
    options = {"seed": seed} if seed else {}
    value, *ends = metrics.ratio_difference((HITS, TRIALS), (OTHERS, TRIED), GROUPS, **options)
    assert value == pytest.approx(HITS.sum() / TRIALS.sum() - OTHERS.sum() / TRIED.sum())
    assert ends == pytest.approx(np.percentile(values, [100 * _tail(7), 100 - 100 * _tail(7)]))


def _tail(groups: int) -> float:
    """Return the share left out on each side: that of the normal distribution beyond Student's quantile, which is
    widened because the variance of resamples is (n - 1) / n of that of a sample.
    """
    wide = stats.t.isf(0.025, groups - 1) * np.sqrt(groups / (groups - 1))
    return float(stats.norm.sf(wide))


def test_intervals_of_few_cases_hold_the_truth_nineteen_times_in_twenty() -> None:
    # ten cases, five repeats: a case is better or worse than all by 0.1, a repeat than its case by 0.05
    held, plain, tries = 0, 0, 400
    for seed in range(tries):
        rng = np.random.default_rng(seed)
        hits = 0.8 + np.repeat(rng.normal(0, 0.1, 10), 5) + rng.normal(0, 0.05, 50)
        cases, ones = np.repeat(np.arange(10), 5), np.ones(50)
        _, low, high = metrics.ratio_interval(hits, ones, groups=cases)
        held += low < 0.8 < high
        values = np.append(hits, 0.0)[metrics._resamples(50, cases, 0)].sum(-1) / 50
        plain += np.percentile(values, 2.5) < 0.8 < np.percentile(values, 97.5)
    assert 0.93 < held / tries < 0.98, held / tries
    assert plain / tries < 0.93, "without the correction"


def test_resamples_without_a_trial_are_left_out() -> None:
    few, all_of_them = np.array([1.0, 0.0, 0.0]), np.ones(3)
    for ours, theirs in (((few, few), (all_of_them / 2, all_of_them)), ((all_of_them / 2, all_of_them), (few, few))):
        assert np.isfinite(metrics.ratio_difference(ours, theirs, ["a", "b", "c"])).all()


def test_two_cases_are_two_however_often_they_are_repeated() -> None:
    hits, ones, cases = np.tile([0.1, 0.9], 20), np.ones(40), np.repeat([0, 1], 20)
    values = np.append(hits, 0.0)[metrics._resamples(40, cases, 0)].sum(-1) / 40
    assert metrics.ratio_interval(hits, ones, groups=cases)[1:] == (values.min(), values.max())


def test_all_hits_or_none_leave_room_for_the_next_table() -> None:
    ones, cases = np.ones(20), np.repeat(np.arange(5), 4)
    exact = stats.binomtest(20, 20).proportion_ci(method="exact")
    assert metrics.ratio_interval(ones, ones) == pytest.approx((1.0, exact.low, exact.high))
    exact = stats.binomtest(0, 5).proportion_ci(method="exact")
    assert metrics.ratio_interval(np.zeros(20), ones, groups=cases) == pytest.approx((0.0, exact.low, exact.high))
    exact = stats.binomtest(4, 4).proportion_ci(method="exact")
    one_case = metrics.ratio_interval(np.ones(4), np.array([1, 1, 1, 1]), groups=["a"] * 4)
    assert one_case == pytest.approx((1.0, exact.low, exact.high)), "its tables are what there is"


def test_one_trial_is_enough_and_none_is_too_few() -> None:
    one, none = np.array([1.0, 0.0]), np.zeros(2)
    assert metrics.ratio_interval(one, one) == pytest.approx((1.0, 0.025, 1.0))
    assert metrics.ratio_difference((one, one), (none, one), ["a", "a"]) == (1.0, 1.0, 1.0)
    for ours, theirs in (((one, none), (one, one)), ((one, one), (one, none)), ((one, none), (one, none))):
        assert np.isnan(metrics.ratio_difference(ours, theirs, ["a", "a"])).all()
    assert np.isnan(metrics.ratio_interval(one, none)).all()
