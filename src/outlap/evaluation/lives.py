"""The out-lap protocol: one life of a driver in a car that it has never met.

A life begins at a standstill on the start line. It lasts three laps and 3.5 minimum-time laps of that very car, at most
six; a crash ends it. What a driver remembers is kept throughout. Under the protocol `practice`, 60 s of driving with a
fresh car after each crash come first, and the memory is kept from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver
from outlap.envs.actions import driver_actions
from outlap.envs.car_sets import CarSet
from outlap.envs.race import EGO
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.terminations import TerminationConfig
from outlap.evaluation.protocol import car_ends, episode_seeds, episode_task
from outlap.planning.limits import CarLimits
from outlap.planning.min_laps import MinLaps, min_laps
from outlap.simulator import state as column
from outlap.simulator.vehicle import parameter_bounds, to_records
from outlap.track.track import Track

PROTOCOL = "outlap-v1"
LAPS = 3
LONGEST = 6.0  # [minimum-time laps] of a life
WINDOW = (1.5, 3.5)  # [minimum-time laps] after the start, between which metres count
PRACTICE = 60.0  # [s]

Protocol = Literal["life", "practice"]


@dataclass(frozen=True, eq=False)
class Yardstick:
    """The minimum-time lap of each car of a set on a track."""

    seconds: np.ndarray  # (cars,)
    table: MinLaps

    @classmethod
    def of(cls, track: Track, task: RaceConfig, cars: CarSet) -> Yardstick:
        """Return the minimum-time laps of a set of cars, from the table of `planning.min_laps`.

        The table spans the set. Raises OutlapError where no line can be planned.
        """
        table = min_laps(track, car_ends(task, cars), task.model)
        limits = [CarLimits.of_record(record, task.model) for record in car_records(task, cars)]
        return cls(table.of(limits), table)


def car_records(task: RaceConfig, cars: CarSet) -> np.ndarray:
    """Return the cars of a list with all other parameters in the middle of a task's: PARAMETERS (cars,)."""
    values = np.mean(parameter_bounds(task.vehicle, task.actuators, task.lidar, task.sensors), axis=0)
    values = np.tile(values, (cars.size, 1))
    values[:, cars.columns] = cars.values
    return to_records(values)


def live(
    driver: Driver,
    task: RaceConfig,
    track: Track,
    cars: CarSet,
    yardstick: Yardstick,
    protocol: Protocol = "life",
    seed: int = 0,
    on_step: Callable[[float], None] | None = None,
) -> pd.DataFrame:
    """Return the life of a driver in each car of a list on a track: a row for each car and lap.

    Args:
        driver: of the cars.
        task: its sensors and actions; track, cars, start and end are the protocol's.
        track: to race on.
        cars: a list.
        yardstick: of the track and the cars.
        protocol: `life`, or `practice` for 60 s of driving first.
        seed: of sensor noise and practice starts.
        on_step: called after every step with the finished share.

    Returns:
        car (number in the list), track, lap (1 … 3), survived (whether the lap was completed without a crash),
        lap_time_s and lap_time_ratio to the car's minimum-time lap (NaN for a lap that was not completed), distance_m
        (of the life: driven between 1.5 and 3.5 minimum-time laps after the start), max_slip_rad (of the lap),
        crash_s_m (place of the crash along the centreline, NaN without), min_lap_time_s, practice_crashes.

    Raises OutlapError for a driver that does not take the task.
    """
    lives = _Lives(driver, task, track, cars, yardstick, seed)
    practice_share = 0.0
    if protocol == "practice":
        practice_share = PRACTICE / (PRACTICE + float(lives.longest.max()))
        lives.practise(lambda share: None if on_step is None else on_step(practice_share * share))
    lives.race(lambda share: None if on_step is None else on_step(practice_share + (1.0 - practice_share) * share))
    return lives.rows()


class _Lives:
    """The lives of all cars of a list on a track, one in each world."""

    def __init__(
        self, driver: Driver, task: RaceConfig, track: Track, cars: CarSet, yardstick: Yardstick, seed: int
    ) -> None:
        self.driver, self.track, self.cars, self.least = driver, track, cars, yardstick.seconds
        self.longest = LONGEST * self.least
        config, opponents = episode_task(driver, task.model_copy(update={"num_cars": 1, "cars": ""}))
        rules = TerminationConfig(time_limit=float(max(self.longest.max(), PRACTICE)) + 1.0, laps=0, stall_time=0.0)
        start = StartConfig(anywhere=False, speed=0.0, offset=0.0, heading_error=0.0)
        self.config = config.model_copy(update={"termination": rules, "start": start})
        self.env = RaceVectorEnv(
            cars.size, self.config, [track], opponents, cars, autoreset_mode=AutoresetMode.DISABLED
        )
        driver.check(self.env.single_observation_space)
        self.seeds = episode_seeds(seed, track.name, cars.size).tolist()
        count = cars.size
        self.crash_place = np.full(count, np.nan)
        self.lap_times = np.full((count, LAPS), np.nan)
        self.lap_slips = np.zeros((count, LAPS))
        self.last = np.zeros(count)  # [m] where each life is, or ended
        self.marks = np.full((count, len(WINDOW)), np.nan)  # [m] at the ends of the window
        self.practice_crashes = np.zeros(count, np.int64)
        self.begun = False  # whether the driver has a memory

    def _reset(self) -> dict[str, np.ndarray]:
        observation, _ = self.env.reset(seed=self.seeds, options={"cars": np.arange(self.cars.size)})
        if not self.begun:
            self.driver.begin(np.ones(self.cars.size, bool))
            self.begun = True
        return observation

    def practise(self, watch: Callable[[float], None]) -> None:
        """Drive for `PRACTICE` seconds, with a fresh car after each crash."""
        observation = self._reset()
        interval = self.config.control_interval * self.config.timestep
        steps = round(PRACTICE / interval)
        for step in range(steps):
            actions = driver_actions(self.driver, observation, self.cars.size)
            observation, _, terminated, truncated, _ = self.env.step(actions)
            self.practice_crashes += terminated
            over = terminated | truncated
            if over.any():
                options: dict[str, Any] = {"reset_mask": over, "cars": np.arange(self.cars.size)}
                observation, _ = self.env.reset(options=options)
            watch((step + 1) / steps)

    def race(self, watch: Callable[[float], None]) -> None:
        """Live all lives to their ends."""
        observation = self._reset()
        race, count = self.env.race, self.cars.size
        over = np.zeros(count, bool)
        laps = np.zeros(count, np.int64)
        distance, time = np.zeros(count), np.zeros(count)
        while not over.all():
            before, then = distance.copy(), time.copy()
            observation, _, terminated, truncated, _ = self.env.step(driver_actions(self.driver, observation, count))
            time = race.worlds.time.copy()
            distance = race.distance[:, EGO] - race.start[:, EGO]
            self._mark_window(over, before, then, distance, time)
            self._note_laps(over, laps)
            crashed = terminated & ~over
            self.crash_place[crashed] = race.distance[crashed, EGO] % self.track.centerline.length
            over |= terminated | truncated | (time >= self.longest)
            over |= (laps >= LAPS) & (time >= WINDOW[1] * self.least)
            ended = terminated | truncated
            if ended.any() and not over.all():
                options: dict[str, Any] = {"reset_mask": ended, "cars": np.arange(count)}
                observation, _ = self.env.reset(options=options)  # an idle world drives on, unseen
                distance[ended], time[ended] = 0.0, 0.0
            watch(float(np.where(over, 1.0, time / self.longest).mean()))
        for end in range(len(WINDOW)):  # a life that ended before: where it ended
            missing = np.isnan(self.marks[:, end])
            self.marks[missing, end] = self.last[missing]

    def _mark_window(
        self, over: np.ndarray, before: np.ndarray, then: np.ndarray, distance: np.ndarray, time: np.ndarray
    ) -> None:
        """Note the distance at the ends of the window, interpolated between two steps."""
        self.last[~over] = distance[~over]
        for end, share in enumerate(WINDOW):
            at = share * self.least
            passed = ~over & (then < at) & (time >= at)
            part = (at[passed] - then[passed]) / (time[passed] - then[passed])
            self.marks[passed, end] = before[passed] + part * (distance[passed] - before[passed])

    def _note_laps(self, over: np.ndarray, laps: np.ndarray) -> None:
        """Note the slip of the lap under way, and the time of one that was completed."""
        worlds = self.env.race.worlds
        running = np.flatnonzero(~over & (laps < LAPS))
        slip = np.abs(worlds.state[running, EGO, column.SLIP])
        self.lap_slips[running, laps[running]] = np.maximum(self.lap_slips[running, laps[running]], slip)
        new = running[worlds.laps[running, EGO] > laps[running]]
        self.lap_times[new, laps[new]] = worlds.lap_time[new, EGO]
        laps[new] += 1

    def rows(self) -> pd.DataFrame:
        """Return a row for each car and lap."""
        count = self.cars.size
        car, lap = np.repeat(np.arange(count), LAPS), np.tile(np.arange(1, LAPS + 1), count)
        times = self.lap_times.ravel()
        return pd.DataFrame(
            {
                "car": car,
                "track": self.track.name,
                "lap": lap,
                "survived": ~np.isnan(times),
                "lap_time_s": times,
                "lap_time_ratio": times / self.least[car],
                "distance_m": np.maximum(self.marks[car, 1] - self.marks[car, 0], 0.0),
                "max_slip_rad": self.lap_slips.ravel(),
                "crash_s_m": self.crash_place[car],
                "min_lap_time_s": self.least[car],
                "practice_crashes": self.practice_crashes[car],
            }
        )
