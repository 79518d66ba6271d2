"""The numbers of a report, from rows whose answers are known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from outlap.evaluation.statistics import estimate_mean
from outlap.experiments.plan import make_plan
from outlap.experiments.results import claim_of, entries, ratio_over_adaptations, table_result

METHODS = ["vanilla-dr", "mql"]


def rows_of(crash_rates: dict[str, list[float]], tasks=("a", "b"), episodes: int = 20) -> pd.DataFrame:
    """Races in which a share of the episodes crash, the same in every task: by method and seed."""
    found = []
    for method, rates in crash_rates.items():
        for seed, rate in enumerate(rates):
            for task in tasks:
                for episode in range(episodes):
                    crashed = episode < round(rate * episodes)
                    found.append(
                        {
                            "table": "table-3", "method": method, "training_seed": seed, "task": task, "seed": episode,
                            "outcome": "crash" if crashed else "timeout", "duration_s": 1.0 if crashed else 5.0,
                            "last_reward": -1.0 if crashed else 0.25, "episode_return": 1.0,
                            "progress_m": 8.0 if crashed else 32.0, "mean_speed_mps": 6.0,
                            "overtakes": 0, "places_lost": 0,
                        }
                    )  # fmt: skip
    return pd.DataFrame(found)


def result_of(rates: dict[str, list[float]]):
    plan = make_plan(["table-3"], "cpu", METHODS)
    return table_result(plan, plan.tables[0], rows_of(rates))


def test_the_seed_is_the_unit_and_the_spread_is_of_episodes():
    result = result_of({"vanilla-dr": [0.1, 0.2, 0.3], "mql": [0.5, 0.5, 0.5]})
    crashes = result.cells["vanilla-dr"]["crashes"]
    expected = estimate_mean(np.array([50.0, 100.0, 150.0]))
    assert (crashes.mean, crashes.high, crashes.seeds) == pytest.approx((expected.mean, expected.high, 3))
    assert crashes.low == max(expected.low, 0.0) == 0.0  # a count is not below zero
    assert crashes.published == 157
    length = result.cells["vanilla-dr"]["episode_length"]
    assert length.mean == pytest.approx(0.2 * 100 + 0.8 * 500)
    each = np.where(np.arange(120) < 24, 100.0, 500.0)
    assert length.sd == pytest.approx(each.std(ddof=1))
    assert length.published == (423.84, 125.38)
    assert result.cells["mql"]["reward"].mean == pytest.approx(0.5 * -1.0 + 0.5 * 0.25)
    # Progress over that at 8 m/s for 5 s.
    np.testing.assert_allclose(result.scores["mql"], np.full((3, 2), 20.0 / 40.0))


def test_without_other_cars_nobody_overtakes():
    assert not {"overtakes", "places_lost"} & set(result_of({"vanilla-dr": [0.1, 0.2], "mql": [0.5, 0.5]}).metrics)


def test_a_claim_is_made_only_where_the_interval_leaves_out_zero():
    clear = result_of({"vanilla-dr": [0.6, 0.65, 0.7], "mql": [0.1, 0.15, 0.25]})
    by_metric = {each.metric: each for each in clear.comparisons if (each.method, each.other) == ("mql", "vanilla-dr")}
    crashes, progress = by_metric["crashes"], by_metric["progress_m"]
    assert (crashes.claim, progress.claim) == ("better", "better")  # fewer crashes, more progress
    assert crashes.low < crashes.difference < crashes.high < 0.0 < progress.low
    assert (crashes.probability, crashes.probability_low) == (1.0, 1.0)
    unclear = result_of({"vanilla-dr": [0.1, 0.6, 0.3], "mql": [0.2, 0.3, 0.5]})
    assert {each.claim for each in unclear.comparisons} == {"not shown"}
    worse = result_of({"vanilla-dr": [0.1, 0.15, 0.2], "mql": [0.7, 0.75, 0.9]})
    assert {each.claim for each in worse.comparisons} == {"worse"}


@pytest.mark.parametrize(
    ("low", "high", "claim"),
    [
        (0.1, 2.0, "better"),
        (2.0, 0.1, "better"),
        (-2.0, -0.1, "worse"),
        (-1.0, 1.0, "not shown"),
        (0.0, 0.0, "not shown"),
        (float("nan"), float("nan"), "not shown"),
    ],
)
def test_claims(low: float, high: float, claim: str):
    assert claim_of(low, high) == claim


def test_one_seed_shows_nothing():
    result = result_of({"vanilla-dr": [0.9], "mql": [0.0]})
    assert {each.claim for each in result.comparisons} == {"not shown"}
    entry = entries(result)["mql"]["crashes"]
    assert (entry["value"], entry["seeds"], entry["published"]) == (0.0, 1, 183)
    assert np.isnan(entry["low"])


def test_a_ratio_over_adaptations_is_paired_and_geometric():
    updates = pd.DataFrame(
        {
            "seed": np.repeat([0, 1, 0], 6),  # two adaptations start from the first training
            "adaptation_seed": np.repeat([0, 1, 2], 6),
            "rule": ["abc", "none"] * 9,
            "x": [1.0, 2.0] * 3 + [10.0, 80.0] * 3 + [1.0, 32.0] * 3,  # ratios 1/2, 1/8, 1/32
        }
    )
    ratio = ratio_over_adaptations(updates, "abc", "none", "x")
    logs = estimate_mean(np.log([0.125, 0.125]))  # the first training's is between its two
    assert ratio["value"] == pytest.approx(0.125)
    assert (ratio["low"], ratio["high"]) == pytest.approx((np.exp(logs.low), np.exp(logs.high)))
    assert (ratio["seeds"], ratio["adaptations"]) == (2, 3)
