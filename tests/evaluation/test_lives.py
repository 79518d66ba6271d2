"""Lives: how long they last, what counts, that memory is kept, and that a crash ends them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from outlap.drivers.classical import CenterlineFollower
from outlap.drivers.driver import Driver
from outlap.envs.car_sets import CarSet
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.lives import LONGEST, PRACTICE, WINDOW, Yardstick, live
from outlap.planning.min_laps import MinLaps
from synthetic_tracks import ring

RADIUS = 5.0
SPEED = 3.0  # [m/s]
TASK = RaceConfig(
    model="nonlinear_single_track",
    beams=0,
    control_interval=4,
    speed_range=(0.0, 2.0 * SPEED),
    scale_observations=False,
)
CARS = CarSet("two", ("mu", "m"), np.array([[1.0, 3.0], [0.9, 4.0]], np.float32), listed=True)
LAP = 2.0 * math.pi * RADIUS / SPEED  # [s]


def yardstick(seconds: float) -> Yardstick:
    return Yardstick(np.full(CARS.size, seconds), MinLaps((), 0.0))


@dataclass
class Remembering(Driver):
    """Follows the centreline at SPEED, and straight on into the wall at a number of steps, in one of the cars."""

    crash_step: int = 10**9
    crashing_car: int = 0
    name: str = "remembering"
    observation_terms: tuple[str, ...] = ("frenet", "curvature_ahead")
    steps: int = 0
    begun: list[np.ndarray] = field(default_factory=list)

    def begin(self, cars: np.ndarray) -> None:
        self.begun.append(cars.copy())

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.steps += 1
        actions = CenterlineFollower().act(observation)
        actions[:, 1] = 0.0  # the middle of the speeds
        if self.steps >= self.crash_step:
            actions[self.crashing_car] = (-1.0, 1.0)
        return actions


def test_a_life_lasts_three_laps_and_counts_the_metres_of_the_window() -> None:
    driver = Remembering()
    rows: Any = live(driver, TASK, ring(RADIUS), CARS, yardstick(0.8 * LAP))
    assert list(rows["car"]) == [0, 0, 0, 1, 1, 1]
    assert list(rows["lap"]) == [1, 2, 3, 1, 2, 3]
    assert rows["survived"].all()
    assert rows["crash_s_m"].isna().all()
    later: Any = rows[rows["lap"] > 1]
    np.testing.assert_allclose(later["lap_time_s"], LAP, rtol=0.03)  # a car that corners drives a little slower
    np.testing.assert_allclose(rows["lap_time_ratio"], rows["lap_time_s"] / (0.8 * LAP), rtol=1e-12)
    assert (rows[rows["lap"] == 1]["lap_time_s"].to_numpy() > later["lap_time_s"].max()).all()  # from a standstill
    speed = 2.0 * math.pi * RADIUS / later["lap_time_s"].to_numpy()[0]
    np.testing.assert_allclose(rows["distance_m"], speed * (WINDOW[1] - WINDOW[0]) * 0.8 * LAP, rtol=0.01)
    assert len(driver.begun) == 1
    assert driver.steps * 0.04 == pytest.approx(rows["lap_time_s"].sum() / 2, abs=0.2)


def test_the_life_of_a_slow_car_ends_after_six_minimum_time_laps() -> None:
    driver = Remembering()
    rows: Any = live(driver, TASK, ring(RADIUS), CARS, yardstick(LAP / 4.0))  # 1.5 laps of this driver
    assert rows[rows["lap"] == 1]["survived"].all()
    assert not rows[rows["lap"] > 1]["survived"].any()
    assert rows[rows["lap"] > 1]["lap_time_ratio"].isna().all()
    assert driver.steps * 0.04 == pytest.approx(LONGEST * LAP / 4.0, abs=0.05)


def test_a_life_goes_on_to_the_end_of_the_window() -> None:
    driver = Remembering()
    rows: Any = live(driver, TASK, ring(RADIUS), CARS, yardstick(1.2 * LAP))  # three laps are over after 2.5 yardsticks
    assert rows["survived"].all()
    assert driver.steps * 0.04 == pytest.approx(WINDOW[1] * 1.2 * LAP, abs=0.05)
    np.testing.assert_allclose(rows["distance_m"], 2.4 * LAP * SPEED, rtol=0.04)


def test_a_crash_ends_a_life_and_no_other() -> None:
    driver = Remembering(crash_step=round(2.0 * LAP / 0.04))
    rows: Any = live(driver, TASK, ring(RADIUS), CARS, yardstick(0.9 * LAP))
    crashed, other = (rows[rows["car"] == car] for car in (0, 1))
    assert list(crashed["survived"]) == [True, False, False]
    assert other["survived"].all()
    assert 0.0 <= crashed["crash_s_m"].iloc[0] <= 2.0 * math.pi * RADIUS
    assert other["crash_s_m"].isna().all()
    # From 1.35 laps of time to the crash, at two laps of time and a little.
    assert crashed["distance_m"].iloc[0] == pytest.approx((2.0 - 1.35) * LAP * SPEED, abs=3.0)
    early: Any = live(Remembering(crash_step=10), TASK, ring(RADIUS), CARS, yardstick(0.9 * LAP))
    assert (early[early["car"] == 0]["distance_m"] == 0.0).all()


def test_practice_comes_first_its_crashes_are_counted_and_memory_is_kept() -> None:
    driver = Remembering(crash_step=round((PRACTICE - 8.0) / 0.04), crashing_car=1)
    rows: Any = live(driver, TASK, ring(RADIUS), CARS, yardstick(0.9 * LAP), "practice")
    by_car = rows.groupby("car")["practice_crashes"].first()
    assert by_car[0] == 0
    assert by_car[1] >= 1
    assert len(driver.begun) == 1
    assert rows[rows["car"] == 0]["survived"].all()
    assert not rows[rows["car"] == 1]["survived"].any()  # it still drives straight on
