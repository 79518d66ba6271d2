"""Statistics of the out-lap benchmark: what a method recovers of the gap between a blind driver and an oracle.

The recovered gap is G = (J - J_blind) / (J_oracle - J_blind), a ratio of means over the same cars and tracks, where J
are the metres of a life between 1.5 and 3.5 minimum-time laps after the start. Intervals are those of a hierarchical
bootstrap, which resamples the trainings of each method and then the cars, the same cars for all methods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from outlap.evaluation.lives import LAPS
from outlap.evaluation.statistics import LEVEL, RESAMPLES

LEAST_GAP = 0.05  # part by which an oracle must be better than a blind driver for G to be defined


@dataclass(frozen=True, eq=False)
class MethodLives:
    """The lives of a method: arrays whose first two axes are (trainings, cars), means over tracks."""

    distance: np.ndarray  # (trainings, cars) [m] of the window
    survived: np.ndarray  # (trainings, cars, LAPS)
    ratio: np.ndarray  # (trainings, cars, LAPS) lap time / minimum-time lap; NaN where no lap was completed

    @classmethod
    def of(cls, lives: pd.DataFrame) -> MethodLives:
        """Return the lives of one method from the rows of `lives.live` with their `training_seed`."""

        def table(column: str) -> np.ndarray:
            return np.stack(
                [
                    lives[lives["lap"] == lap].pivot_table(
                        column, "training_seed", "car", "mean", dropna=False
                    ).to_numpy(np.float64)
                    for lap in range(1, LAPS + 1)
                ],
                axis=-1,
            )  # fmt: skip

        return cls(table("distance_m")[..., 0], table("survived"), table("lap_time_ratio"))

    def resampled(self, trainings: np.ndarray, cars: np.ndarray) -> MethodLives:
        """Return the lives of these trainings and cars."""
        chosen = np.ix_(trainings, cars)
        return MethodLives(self.distance[chosen], self.survived[chosen], self.ratio[chosen])


def summarise_lives(lives: pd.DataFrame, blind: str, oracle: str | None, seed: int = 0) -> dict[str, Any]:
    """Return survival, lap-time ratios, distances and recovered gaps of every method.

    Args:
        lives: rows of `lives.live` with `method` and `training_seed`; the same cars and tracks for every training.
        blind, oracle: names of methods; without an oracle there is no recovered gap.
        seed: of the bootstrap.

    Returns:
        By method: trainings, lives, survival and lap_time_ratio (by `lap_1` …), distance_m, recovered_gap (None where
        the oracle is less than 5 % better than the blind driver), p_holm (of a difference in distance to the blind
        driver, corrected by Holm's method for the number of methods; None for the blind driver). Estimates are
        {"value", "low", "high", "seeds"} with a 95 % interval.
    """
    methods = {str(name): MethodLives.of(rows) for name, rows in lives.groupby("method", sort=False)}
    rng = np.random.default_rng(seed)
    cars = next(iter(methods.values())).distance.shape[1]
    samples: list[dict[str, MethodLives]] = []
    for _ in range(RESAMPLES):
        chosen = rng.integers(cars, size=cars)
        samples.append(
            {
                name: each.resampled(rng.integers(len(each.distance), size=len(each.distance)), chosen)
                for name, each in methods.items()
            }
        )

    def estimate(name: str, statistic: Callable[[Mapping[str, MethodLives]], float]) -> dict[str, Any]:
        found = np.array([statistic(sample) for sample in samples])
        found = found[np.isfinite(found)]
        ends = (0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL)
        low, high = np.quantile(found, ends).tolist() if len(found) else (np.nan, np.nan)
        value = statistic(methods)
        return {"value": value, "low": low, "high": high, "seeds": len(methods[name].distance)}

    gap = None if oracle is None else _gap(methods, blind, oracle)
    p_values = {name: _p_value(samples, name, blind) for name in methods if name != blind}
    corrected = holm(p_values)
    summary: dict[str, Any] = {}
    for name, each in methods.items():
        laps = range(LAPS)
        summary[name] = {
            "trainings": len(each.distance),
            "lives": int(np.count_nonzero(np.asarray(lives["method"]) == name) // LAPS),
            "survival": {f"lap_{k + 1}": estimate(name, _mean_of(name, "survived", k)) for k in laps},
            "lap_time_ratio": {f"lap_{k + 1}": estimate(name, _mean_of(name, "ratio", k)) for k in laps},
            "distance_m": estimate(name, lambda found, name=name: float(found[name].distance.mean())),
            "recovered_gap": None
            if oracle is None or gap is None or gap < LEAST_GAP
            else estimate(name, lambda found, name=name: recovered_gap(found, name, blind, oracle)),
            "p_holm": corrected.get(name),
        }
    return summary


def recovered_gap(methods: Mapping[str, MethodLives], name: str, blind: str, oracle: str) -> float:
    """Return (J - J_blind) / (J_oracle - J_blind) of a method; NaN where oracle and blind are equal."""
    j, low, high = (float(methods[each].distance.mean()) for each in (name, blind, oracle))
    return (j - low) / (high - low) if high != low else float("nan")


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Return p-values corrected for their number by Holm's step-down method (Holm, 1979)."""
    corrected: dict[str, float] = {}
    largest = 0.0
    for rank, name in enumerate(sorted(p_values, key=lambda each: p_values[each])):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[name]))
        corrected[name] = largest
    return corrected


def _mean_of(name: str, field: str, lap: int) -> Callable[[Mapping[str, MethodLives]], float]:
    def mean(found: Mapping[str, MethodLives]) -> float:
        values = getattr(found[name], field)[..., lap]
        known = values[~np.isnan(values)]
        return float(known.mean()) if len(known) else float("nan")

    return mean


def _gap(methods: Mapping[str, MethodLives], blind: str, oracle: str) -> float:
    """The part by which the oracle drives farther than the blind driver."""
    return float(methods[oracle].distance.mean() / max(methods[blind].distance.mean(), 1e-9) - 1.0)


def _p_value(samples: list[dict[str, MethodLives]], name: str, blind: str) -> float:
    """The two-sided bootstrap p-value of a difference in mean distance to the blind driver."""
    differences = np.array([sample[name].distance.mean() - sample[blind].distance.mean() for sample in samples])
    tail = min(float((differences <= 0.0).mean()), float((differences >= 0.0).mean()))
    return min(1.0, max(2.0 * tail, 1.0 / len(samples)))
