"""Intervals against SciPy, against hand calculations, and against what they promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from outlap.evaluation.statistics import (
    estimate_mean,
    interquartile_mean,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    probability_of_improvement_interval,
    stratified_bootstrap,
    wilson_interval,
)


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


# Scores (seeds, tasks), and what rliable 1.2.0 (NumPy 2.4.6, pandas 2.3.3, arch 7.2.0) says of them, with 20,000
# resamples from RandomState(0): `metrics.aggregate_iqm`, `get_interval_estimates` and so on.
A = np.random.default_rng(0).normal(0.6, 0.2, (8, 4))
B = np.random.default_rng(1).normal(0.5, 0.2, (6, 4))
RLIABLE = {
    "iqm": 0.5638330446224893,
    "iqm_interval": (0.51187424, 0.62405737),
    "improvement": 0.578125,
    "thresholds": np.array([0.2, 0.4, 0.6, 0.8]),
    "profile": [0.96875, 0.875, 0.4375, 0.09375],
}


def iqm_of_columns(columns: list[np.ndarray]) -> float:
    return interquartile_mean(np.concatenate(columns, axis=1))


def test_statistics_of_several_seeds_are_rliables():
    assert interquartile_mean(A) == pytest.approx(RLIABLE["iqm"])
    assert probability_of_improvement(A, B) == RLIABLE["improvement"]
    assert performance_profile(A, RLIABLE["thresholds"]).tolist() == RLIABLE["profile"]
    # rliable resamples every task by itself: tasks are the strata.
    columns = [A[:, [task]] for task in range(A.shape[1])]
    interval = stratified_bootstrap(columns, iqm_of_columns, resamples=5000)
    assert interval == pytest.approx(RLIABLE["iqm_interval"], abs=0.004)


def test_statistics_of_several_seeds_are_those_of_the_rliable_that_is_installed():
    try:
        from rliable import library, metrics  # type: ignore[import-not-found]

        _, intervals = library.get_interval_estimates(
            {"a": B}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=5000, random_state=np.random.RandomState(1)
        )
    except Exception as error:  # it needs versions of pandas and arch that fit each other
        pytest.skip(f"needs a working rliable: {error}")
    assert interquartile_mean(B) == pytest.approx(metrics.aggregate_iqm(B))
    assert probability_of_improvement(B, A) == pytest.approx(metrics.probability_of_improvement(B, A))
    interval = stratified_bootstrap([B[:, [task]] for task in range(4)], iqm_of_columns, resamples=5000)
    assert interval == pytest.approx(intervals["a"].ravel(), abs=0.006)


def test_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0])) == 2.5
    assert interquartile_mean(np.array([[5.0]])) == 5.0


def test_a_bootstrap_keeps_the_tasks_of_a_seed_together():
    # Every seed's two tasks cancel: however seeds are drawn, the mean is 0. Tasks drawn apart would spread it.
    scores = np.array([[1.0, -1.0], [5.0, -5.0], [-3.0, 3.0]])
    assert stratified_bootstrap([scores], lambda found: float(found[0].mean())) == (0.0, 0.0)


def test_a_bootstrap_draws_every_stratum_by_itself_and_repeats():
    strata = [np.array([[0.0], [1.0]]), np.array([[10.0], [10.0], [10.0]])]
    sizes = []

    def statistic(found: list[np.ndarray]) -> float:
        sizes.append([len(scores) for scores in found])
        return float(found[0].mean() + found[1].mean())

    first = stratified_bootstrap(strata, statistic, seed=3, resamples=200)
    assert first == (10.0, 11.0)
    assert sizes == [[2, 3]] * 200
    values = np.random.default_rng(0).normal(size=(5, 3))
    intervals = [stratified_bootstrap([values], lambda found: float(found[0].mean()), seed) for seed in (0, 0, 1)]
    assert intervals[0] == intervals[1] != intervals[2]


def test_one_seed_has_no_interval():
    low, high = stratified_bootstrap([np.ones((1, 4))], lambda found: float(found[0].mean()))
    assert math.isnan(low)
    assert math.isnan(high)


def test_how_often_a_bootstrap_of_five_seeds_holds_the_mean():
    # What its docstring says, and why claims are made from Student's interval.
    rng = np.random.default_rng(0)
    held = []
    for _ in range(400):
        low, high = stratified_bootstrap(
            [rng.normal(1.0, 1.0, (5, 1))], lambda found: float(found[0].mean()), resamples=400
        )
        held.append(low <= 1.0 <= high)
    assert np.mean(held) == pytest.approx(0.83, abs=0.07)  # four standard errors of 400 trials


def test_improvement_by_hand():
    a, b = np.array([[1.0], [3.0]]), np.array([[2.0], [3.0]])
    # 1 < 2, 1 < 3, 3 > 2, 3 = 3.
    assert probability_of_improvement(a, b) == (0 + 0 + 1 + 0.5) / 4
    assert probability_of_improvement(b, a) == 1.0 - probability_of_improvement(a, b)
    assert probability_of_improvement_interval(a + 10.0, b) == (1.0, 1.0)
    assert probability_of_improvement_interval(np.vstack([a, a]) + 10.0, b) == (1.0, 1.0)


def test_a_difference_is_paired_by_seed():
    rng = np.random.default_rng(0)
    seed, task = rng.normal(0.0, 10.0, (6, 1)), rng.normal(0.0, 10.0, (1, 3))
    a = seed + task + rng.normal(0.5, 0.1, (6, 3))
    b = seed + task
    estimate = paired_difference(a, b)
    low, high = stats.ttest_rel(a.mean(axis=1), b.mean(axis=1)).confidence_interval()
    assert (estimate.low, estimate.high) == pytest.approx((low, high))
    assert 0.3 < estimate.low < estimate.high < 0.7  # what seeds and tasks have in common is gone
