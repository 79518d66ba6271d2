"""How well numbers measured on a sample are known: of episodes, or of trainings with different seeds.

Scores of several trainings are arrays (seeds, tasks); one seed is one row, since its tasks are raced by one training.
Methods that were trained for each task set anew have one such array a task set: a stratum of the bootstrap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

LEVEL = 0.95  # of every interval
RESAMPLES = 2000


class Estimate(NamedTuple):
    """A mean with its spread; NaN where there are too few values."""

    mean: float
    sd: float  # of the values, not of the mean; n - 1 in the denominator
    low: float  # ends of the interval of the mean
    high: float


def estimate_mean(values: np.ndarray, level: float = LEVEL) -> Estimate:
    """Mean and standard deviation of independent values (n,), and Student's t interval of the mean.

    Student's t rather than a bootstrap: with few values percentile intervals are too narrow, with many both
    agree, and this one needs no random numbers. No value gives NaNs, one value a mean without an interval.
    """
    values = np.asarray(values, np.float64)
    n = len(values)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, math.nan)
    mean = float(values.mean())
    if n == 1:
        return Estimate(mean, math.nan, math.nan, math.nan)
    sd = float(values.std(ddof=1))
    half = float(stats.t.ppf(0.5 + 0.5 * level, n - 1)) * sd / math.sqrt(n)
    return Estimate(mean, sd, mean - half, mean + half)


def wilson_interval(count: int, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Interval of the probability of something that happened `count` times in `n` independent trials.

    Wilson (1927), Probable inference, the law of succession, and statistical inference. It stays within
    [0, 1] and has a width for 0 of n too. NaNs where n = 0.
    """
    if not 0 <= count <= n:
        raise ValueError(f"count is {count}; must be between 0 and n = {n}")
    if n == 0:
        return math.nan, math.nan
    interval = stats.binomtest(count, n).proportion_ci(level, "wilson")
    return float(interval.low), float(interval.high)


def interquartile_mean(values: np.ndarray) -> float:
    """The mean of the middle half of all values, of whatever shape: one good or bad training moves it little.

    Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice.
    """
    return float(stats.trim_mean(np.ravel(values), 0.25))


def stratified_bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Callable[[list[np.ndarray]], float],
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Percentile interval of a statistic, from resampling the seeds of every stratum with replacement.

    With five seeds such an interval of a mean holds the truth in some 83 % of cases, not in 95 %: claims are made from
    `paired_difference`. NaNs where a stratum has one seed only.

    Args:
        strata: scores (seeds, ...) of every stratum; rows stay whole.
        statistic: of the strata.
        seed: of the resampling.
        resamples: how many.
        level: of the interval.
    """
    if any(len(scores) < 2 for scores in strata):
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    found = [
        statistic([scores[rng.integers(len(scores), size=len(scores))] for scores in strata]) for _ in range(resamples)
    ]
    low, high = np.quantile(found, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return float(low), float(high)


def probability_of_improvement(a: np.ndarray, b: np.ndarray) -> float:
    """How likely a training of one method scores higher than one of the other, ties counting half; mean over tasks.

    Args:
        a, b: scores (seeds, tasks); as many tasks, any number of seeds. Mann and Whitney's U over its largest value.
    """
    above = a[:, None, :] > b[None, :, :]
    equal = a[:, None, :] == b[None, :, :]
    return float((above + 0.5 * equal).mean())


def probability_of_improvement_interval(a: np.ndarray, b: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Its percentile interval; both methods' seeds are resampled, paired if there are as many."""
    if len(a) == len(b):
        both = np.stack([a, b], axis=1)
        return stratified_bootstrap(
            [both], lambda found: probability_of_improvement(found[0][:, 0], found[0][:, 1]), seed
        )
    return stratified_bootstrap([a, b], lambda found: probability_of_improvement(*found), seed)


def performance_profile(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The share of all trainings and tasks whose score is above each threshold: (thresholds,)."""
    return (np.ravel(scores)[:, None] > thresholds).mean(axis=0)


def paired_difference(a: np.ndarray, b: np.ndarray) -> Estimate:
    """a - b of equal seeds, mean over tasks: the seeds' mean difference with Student's t interval.

    Args:
        a, b: scores (seeds, tasks) of the same seeds and tasks.
    """
    return estimate_mean((a - b).mean(axis=1))
