"""The recovered gap and its statistics, against closed forms and published examples."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from outlap.evaluation.recovered_gap import holm, summarise_lives

CARS, LAPS = 8, 3


def lives(method: str, distances: np.ndarray, survived: bool = True) -> pd.DataFrame:
    """Rows of a method whose trainings drove (trainings, cars) [m] on two tracks."""
    rows = []
    for training, car in np.ndindex(*distances.shape):
        for track, more in (("a", -1.0), ("b", 1.0)):
            for lap in range(1, LAPS + 1):
                ratio = 1.0 + 0.1 * lap if survived else np.nan
                rows.append((method, training, car, track, lap, survived, ratio, distances[training, car] + more))
    names = ("method", "training_seed", "car", "track", "lap", "survived", "lap_time_ratio", "distance_m")
    return pd.DataFrame(rows, columns=list(names))


def test_the_gap_is_a_ratio_of_means() -> None:
    rng = np.random.default_rng(0)
    blind, half, oracle = 100.0 + rng.normal(0, 1, (5, CARS)), np.full((5, CARS), 130.0), np.full((3, CARS), 160.0)
    rows = pd.concat([lives("blind", blind), lives("half", half), lives("oracle", oracle)])
    summary = summarise_lives(rows, "blind", "oracle")
    expected = (130.0 - blind.mean()) / (160.0 - blind.mean())
    assert summary["half"]["recovered_gap"]["value"] == pytest.approx(expected, rel=1e-9)
    assert summary["half"]["recovered_gap"]["low"] < expected < summary["half"]["recovered_gap"]["high"]
    assert summary["half"]["recovered_gap"]["seeds"] == 5
    assert summary["blind"]["recovered_gap"]["value"] == 0.0
    assert summary["oracle"]["recovered_gap"]["value"] == 1.0
    assert (summary["oracle"]["trainings"], summary["oracle"]["lives"]) == (3, 3 * CARS * 2)
    assert summary["half"]["distance_m"] == {"value": 130.0, "low": 130.0, "high": 130.0, "seeds": 5}
    assert summary["half"]["survival"]["lap_3"]["value"] == 1.0
    assert summary["half"]["lap_time_ratio"]["lap_2"]["value"] == pytest.approx(1.2)
    assert summary["half"]["p_holm"] < 0.01
    assert summary["blind"]["p_holm"] is None


def test_the_interval_of_a_mean_is_about_that_of_its_standard_error() -> None:
    """Trainings that do not differ leave the spread of cars: a normal interval of a mean of cars."""
    cars = np.tile(np.random.default_rng(1).normal(100.0, 10.0, 200), (2, 1))
    low_and_high = summarise_lives(lives("blind", cars), "blind", None)["blind"]["distance_m"]
    half = 1.96 * cars[0].std() / np.sqrt(200)
    assert low_and_high["high"] - low_and_high["value"] == pytest.approx(half, rel=0.15)
    assert low_and_high["value"] - low_and_high["low"] == pytest.approx(half, rel=0.15)


def test_trainings_that_differ_widen_the_interval() -> None:
    same = np.full((5, CARS), 100.0)
    other = same + np.array([-20.0, -10.0, 0.0, 10.0, 20.0])[:, None]
    for values, width in ((same, 0.0), (other, 20.0)):
        found = summarise_lives(lives("blind", values), "blind", None)["blind"]["distance_m"]
        assert found["high"] - found["low"] >= width


def test_there_is_no_gap_where_the_oracle_is_hardly_better() -> None:
    blind, oracle = np.full((2, CARS), 100.0), np.full((2, CARS), 104.0)
    summary = summarise_lives(pd.concat([lives("blind", blind), lives("oracle", oracle)]), "blind", "oracle")
    assert summary["oracle"]["recovered_gap"] is None
    assert summarise_lives(lives("blind", blind), "blind", None)["blind"]["recovered_gap"] is None


def test_a_lap_that_nobody_completed_has_no_ratio() -> None:
    summary = summarise_lives(lives("blind", np.full((2, CARS), 1.0), survived=False), "blind", None)
    assert np.isnan(summary["blind"]["lap_time_ratio"]["lap_1"]["value"])
    assert summary["blind"]["survival"]["lap_1"]["value"] == 0.0


def test_holms_correction_of_a_worked_example() -> None:
    # Sorted 0.005, 0.01, 0.03, 0.04 times 4, 3, 2, 1, and never falling.
    corrected = holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.005})
    assert corrected == pytest.approx({"a": 0.03, "b": 0.06, "c": 0.06, "d": 0.02})
