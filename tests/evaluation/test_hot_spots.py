"""Crash hot spots are found where crashes cluster, and nowhere else."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from outlap.evaluation.hot_spots import find_clusters, hot_spots


def rows_of(**crashes: list[float]) -> pd.DataFrame:
    """Rows of ten finished episodes on each track, and of crashes at places [m]."""
    rows = [
        {"track": track, "outcome": outcome, "crash_s_m": s}
        for track, places in crashes.items()
        for outcome, s in [("finished", np.nan)] * 10 + [("crash", place) for place in places]
    ]
    return pd.DataFrame(rows, columns=["track", "outcome", "crash_s_m"])


def spots_of(length: float, places: list[float]) -> list[tuple[float, int, float]]:
    found = hot_spots(rows_of(A=places), {"A": length})
    assert {spot["track"] for spot in found} <= {"A"}
    return [(spot["s_m"], spot["crashes"], spot["share"]) for spot in found]


@pytest.mark.parametrize("places", [[], [10.0], [10.0, 10.1]])
def test_fewer_than_three_crashes_are_no_hot_spot(places):
    assert spots_of(300.0, places) == []


def test_three_crashes_within_five_metres_of_a_long_lap_are_one():
    assert spots_of(300.0, [12.0, 10.0, 14.9]) == [(12.0, 3, 1.0)]
    assert spots_of(300.0, [12.0, 10.0, 15.1]) == []
    # 3 (5 / 80)^2 = 0.0117: on a short lap three that lie together are no surprise.
    assert spots_of(80.0, [12.0, 10.0, 14.9]) == []


def test_a_hot_spot_may_lie_across_the_start_line():
    assert spots_of(300.0, [299.0, 299.6, 0.4, 1.0, 150.0]) == [(0.0, 4, 0.8)]
    assert spots_of(300.0, [298.0, 298.5, 299.0, 1.0]) == [(298.8, 4, 1.0)]


def test_how_many_are_a_surprise_depends_on_how_many_there_are():
    """20 crashes on 200 m: 20 P(X >= 4) = 0.022 with X of B(19, 1/40), and 20 P(X >= 5) = 0.0017."""
    chance = 20 * stats.binom.sf(np.array([3, 4]), 19, 1 / 40)
    assert chance == pytest.approx([0.022, 0.0017], rel=0.05)
    spread = list(np.linspace(20.0, 190.0, 15))
    assert spots_of(200.0, [*spread, 5.0, 5.1, 5.2, 5.3, 5.4]) == []
    assert spots_of(200.0, [*spread[1:], 5.0, 5.1, 5.2, 5.3, 5.4, 5.5]) == [(5.2, 6, 0.3)]


def test_a_crowded_corner_hides_no_other():
    """Among 60 crashes five are no surprise, but among the ten that lie outside of the first hot spot they are."""
    elsewhere = [40.0, 90.0, 180.0, 230.0, 280.0]
    places = [*np.linspace(100.0, 104.0, 50), *np.linspace(200.0, 201.0, 5), *elsewhere]
    assert spots_of(350.0, places) == [(102.0, 50, 50 / 60), (200.5, 5, 5 / 60)]


def test_a_corner_longer_than_a_window_is_one_hot_spot():
    assert spots_of(400.0, list(np.linspace(100.0, 112.0, 49))) == [(106.0, 49, 1.0)]


def test_each_track_has_its_own_and_those_with_most_crashes_come_first():
    rows = rows_of(A=[10.0, 11.0, 12.0, 50.0], B=[], C=[7.0, 7.0, 7.0, 7.0, 7.5], D=[30.0, 130.0, 230.0])
    found = hot_spots(rows, {"A": 300.0, "B": 300.0, "C": 200.0, "D": 300.0})
    assert found == [
        {"track": "C", "s_m": 7.0, "crashes": 5, "share": 1.0},
        {"track": "A", "s_m": 11.0, "crashes": 3, "share": 0.75},
    ]


@pytest.mark.parametrize(("crashes", "length"), [(5, 100.0), (30, 300.0), (200, 400.0)])
def test_crashes_that_fall_anywhere_have_a_hot_spot_less_than_once_in_a_hundred_times(crashes, length):
    rng = np.random.default_rng(7)
    alarms = sum(bool(find_clusters(rng.uniform(0.0, length, crashes), length)) for _ in range(1000))
    assert alarms <= 20  # a binomial count with mean 10 at most exceeds this once in 600 times
