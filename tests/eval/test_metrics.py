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
