"""How well numbers measured on a sample of episodes are known."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

LEVEL = 0.95  # of every interval


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
    half = float(special.stdtrit(n - 1, 0.5 + 0.5 * level)) * sd / math.sqrt(n)
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
    z = float(special.ndtri(0.5 + 0.5 * level))
    share = count / n
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    # In exact arithmetic the ends of 0 and n are 0 and 1.
    low = 0.0 if count == 0 else max(0.0, middle - half)
    high = 1.0 if count == n else min(1.0, middle + half)
    return low, high
