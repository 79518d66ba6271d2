"""Intervals against SciPy, against hand calculations, and against what they promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from outlap.evaluation.statistics import estimate_mean, wilson_interval


@pytest.mark.parametrize("n", [2, 3, 30, 500])
def test_mean_interval_is_students(n):
    values = np.random.default_rng(n).normal(3.0, 2.0, n)
    estimate = estimate_mean(values)
    low, high = stats.t.interval(0.95, n - 1, loc=np.mean(values), scale=stats.sem(values))
    assert estimate.mean == pytest.approx(np.mean(values))
    assert estimate.sd == pytest.approx(np.std(values, ddof=1))
    assert (estimate.low, estimate.high) == pytest.approx((low, high))


def test_mean_interval_by_hand():
    # 1, 2, 3: sd 1, t(2, 0.975) = 4.3027 from the tables, half width 4.3027 / sqrt(3).
    assert estimate_mean(np.array([1.0, 2.0, 3.0])) == pytest.approx((2.0, 1.0, -0.48414, 4.48414), abs=1e-4)


def test_too_few_values():
    assert all(math.isnan(value) for value in estimate_mean(np.array([])))
    mean, *rest = estimate_mean(np.array([5]))
    assert mean == 5.0
    assert all(math.isnan(value) for value in rest)


def test_equal_values_have_an_interval_without_width():
    assert estimate_mean(np.full(4, 7.0)) == (7.0, 0.0, 7.0, 7.0)


def test_mean_interval_holds_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    intervals = [estimate_mean(rng.normal(1.0, 1.0, 5)) for _ in range(2000)]
    share = np.mean([estimate.low <= 1.0 <= estimate.high for estimate in intervals])
    assert share == pytest.approx(0.95, abs=0.02)  # four standard errors of 2000 trials


@pytest.mark.parametrize(("count", "n"), [(0, 1), (0, 100), (1, 100), (37, 80), (99, 100), (500, 500)])
def test_wilson_interval_is_scipys(count, n):
    low, high = stats.binomtest(count, n).proportion_ci(0.95, method="wilson")
    assert wilson_interval(count, n) == pytest.approx((low, high), abs=1e-12)


def test_wilson_interval_by_hand():
    # 0 of n: the upper end is z² / (n + z²), z = 1.96.
    low, high = wilson_interval(0, 100)
    assert low == 0.0
    assert high == pytest.approx(1.96**2 / (100 + 1.96**2), abs=1e-5)


def test_wilson_interval_of_nothing_and_of_nonsense():
    assert all(math.isnan(end) for end in wilson_interval(0, 0))
    with pytest.raises(ValueError, match="count is 3"):
        wilson_interval(3, 2)
