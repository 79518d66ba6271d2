"""The summary of rows that were written by hand."""

from __future__ import annotations

import json
import math

import pandas as pd
import pytest
from scipy import stats

from outlap.evaluation.metrics import summarise

# track, outcome, contact, opponents' crashes, overtakes, places lost, error of the least lap, laps, lap time, ratio,
# speed, progress, steps, return
NAN = math.nan
ROWS = [
    ("A", "crash", "car", 1, 2, 1, NAN, 0, NAN, NAN, 5.0, 10.0, 50, -1.0),
    ("A", "finished", "", 0, 1, 0, 0.002, 3, 60.0, 1.1, 7.0, 1200.0, 4500, 9.0),
    ("A", "timeout", "", 2, 0, 0, 0.002, 1, 80.0, 1.5, 6.0, 700.0, 6000, 4.0),
    ("B", "stalled", "", 0, 0, 4, NAN, 0, NAN, NAN, 0.0, 0.0, 75, 0.0),
]
NAMES = [
    "track", "outcome", "contact", "opponent_crashes", "overtakes", "places_lost", "min_lap_error", "completed_laps",
    "lap_time_s", "lap_time_ratio", "mean_speed_mps", "progress_m", "episode_steps", "episode_return",
]  # fmt: skip
KEYS = {
    "episodes", "crash_rate", "crash_rate_low", "crash_rate_high", "overtakes", "places_lost", "outcomes",
    "contacts", "opponent_crashes", "min_lap_error",
    "completed_laps", "lap_time_s", "lap_time_ratio", "mean_speed_mps", "progress_m", "episode_steps", "episode_return",
}  # fmt: skip


@pytest.fixture
def summary():
    return summarise(pd.DataFrame(ROWS, columns=NAMES))


def test_every_summary_has_exactly_the_promised_keys(summary):
    assert set(summary) == {"all", "tracks"}
    assert list(summary["tracks"]) == ["A", "B"]
    for each in (summary["all"], *summary["tracks"].values()):
        assert set(each) == KEYS
        for name in NAMES[7:]:
            assert set(each[name]) == {"mean", "sd", "low", "high"}


def test_counts_are_counts_and_totals_are_totals(summary):
    a = summary["tracks"]["A"]
    assert (a["episodes"], a["overtakes"], a["places_lost"]) == (3, 3, 1)
    assert a["outcomes"] == {"crash": 1, "finished": 1, "timeout": 1, "stalled": 0}
    assert summary["all"]["places_lost"] == 5
    assert summary["all"]["contacts"] == {"wall": 0, "car": 1}
    assert (a["opponent_crashes"], summary["tracks"]["B"]["opponent_crashes"]) == (3, 0)


def test_crash_rate_counts_crashes_only(summary):
    assert summary["tracks"]["A"]["crash_rate"] == pytest.approx(1 / 3)
    assert summary["tracks"]["B"]["crash_rate"] == 0.0
    whole = summary["all"]
    interval = stats.binomtest(1, 4).proportion_ci(0.95, method="wilson")
    assert (whole["crash_rate_low"], whole["crash_rate_high"]) == pytest.approx(tuple(interval))


def test_an_episode_counts_once(summary):
    # speeds 5, 7, 6: mean 6, sd 1, t(2) = 4.3027
    speed = summary["tracks"]["A"]["mean_speed_mps"]
    half = 4.302653 / math.sqrt(3)
    assert speed == pytest.approx({"mean": 6.0, "sd": 1.0, "low": 6.0 - half, "high": 6.0 + half}, abs=1e-5)
    assert summary["all"]["episode_steps"]["mean"] == pytest.approx((50 + 4500 + 6000 + 75) / 4)


def test_lap_time_is_over_episodes_with_a_lap(summary):
    assert summary["all"]["lap_time_s"]["mean"] == pytest.approx(70.0)  # of 60 and 80, however many laps
    assert summary["tracks"]["B"]["lap_time_s"] == {"mean": None, "sd": None, "low": None, "high": None}


def test_what_is_not_known_is_null_in_json(summary):
    text = json.dumps(summary, allow_nan=False)  # would raise for NaN
    assert json.loads(text)["tracks"]["B"]["mean_speed_mps"] == {"mean": 0.0, "sd": None, "low": None, "high": None}
