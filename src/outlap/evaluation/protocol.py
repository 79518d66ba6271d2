"""The protocol of evaluations: which task a driver races in, from which starts, with which seeds."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver
from outlap.drivers.find import find_drivers
from outlap.envs.car_sets import CarSet, find_cars, parameter_ends
from outlap.envs.observations import check_terms
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.rewards import RewardConfig
from outlap.envs.terminations import TerminationConfig
from outlap.errors import OutlapError
from outlap.simulator.vehicle import parameter_names
from outlap.track.track import Track

CRAWL = 1.0  # [m/s] mean speed at which the default time limit still allows all laps and the way to the line


def standing_starts(
    env: RaceConfig, tracks: Sequence[Track], laps: int = 3, time_limit: float | None = None
) -> RaceConfig:
    """A task as it is evaluated: from a standstill anywhere on the lap, until the laps are done.

    Cars, sensors, actions and rewards stay those of `env`; where cars are put and how an episode ends do not,
    so that policies are compared on the same episodes however they were trained.

    Args:
        env: what the policy was trained on.
        tracks: to evaluate on.
        laps: to complete from line to line; 0 for no end but the time limit.
        time_limit: [s]; by default enough for `laps` + 1 laps of the longest track at 1 m/s.

    Raises OutlapError for neither laps nor a time limit.
    """
    if time_limit is None:
        if laps == 0:
            raise OutlapError("laps is 0; a time limit is needed then")
        time_limit = (laps + 1) * max(track.centerline.length for track in tracks) / CRAWL
    changes = {
        "tracks": tuple(track.name for track in tracks),
        "augment_tracks": False,
        "start": StartConfig(anywhere=True, speed=0.0, gap=env.start.gap, formation=env.start.formation),
        "termination": TerminationConfig(laps=laps, time_limit=time_limit),
    }
    return env.model_copy(update=changes)


def made_for(driver: Driver, env: RaceConfig) -> RaceConfig:
    """Return a task with the scanner and the top speed that a driver declares."""
    changes: dict[str, Any] = {}
    if driver.beams is not None:
        changes["beams"] = driver.beams
    if driver.speeds is not None:
        vehicle = env.vehicle.model_copy(update={"v_max": driver.speeds[1]})
        changes |= {"vehicle": vehicle, "speed_range": driver.speeds}
    return env.model_copy(update=changes)


def with_top_speed(env: RaceConfig, v_max: float | None) -> RaceConfig:
    """Return a task with another top speed of the cars [m/s]; actions still command the same speeds."""
    if v_max is None:
        return env
    vehicle = env.vehicle.model_copy(update={"v_max": v_max})
    return env.model_copy(update={"vehicle": vehicle, "speed_range": env.commanded_speeds})


def episode_seeds(seed: int, track: str, episodes: int) -> np.ndarray:
    """The seeds of a track's episodes: int64 (episodes,), the first ones the same however many there are."""
    key = zlib.crc32(track.encode())
    words = [np.random.SeedSequence((seed, key, k)).generate_state(1)[0] for k in range(episodes)]
    return np.array(words, np.int64)


def episode_task(driver: Driver, config: RaceConfig) -> tuple[RaceConfig, list[Driver]]:
    """Return a task as this driver needs it, on one track, and its opponents.

    Raises OutlapError for an observation term that does not exist, and for opponents that cannot be loaded.
    """
    check_terms(driver.observation_terms, driver.name)
    opponents: list[Driver] = []
    if config.num_cars > 1:
        opponents = find_drivers(config.opponents, config.field_of_view, config.opponent_split, config.opponent_code)
    shown = config.reward if driver.reward is None else RewardConfig.model_validate(driver.reward)
    changes: dict[str, Any] = {
        "augment_tracks": False,  # the track that was named, not one of its variants
        "observation": tuple(driver.observation_terms),
        "scale_observations": driver.scale_observations,
        "reward": shown.without_curricula(),
    }
    if not any("scan" in each.observation_terms for each in (driver, *opponents)):
        changes["beams"] = 0  # nobody looks
    return config.model_copy(update=changes), opponents


def single_race(driver: Driver, config: RaceConfig, track: Track) -> RaceVectorEnv:
    """One world as `evaluate` has it for a driver, with the task's scanner even where nobody looks: for pictures.

    Raises OutlapError for a task that the driver does not take.
    """
    task, opponents = episode_task(driver, config)
    task = task.model_copy(update={"beams": config.beams})
    env = RaceVectorEnv(1, task, [track], opponents, autoreset_mode=AutoresetMode.DISABLED)
    driver.check(env.single_observation_space)
    return env


def car_ends(config: RaceConfig, cars: CarSet | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each parameter of a task's cars: float32 (N_PARAMS,) each.

    Args:
        config: the task.
        cars: a set in place of the one that `config.cars` names.
    """
    if cars is None and config.cars:
        cars = find_cars(config.cars)
    return parameter_ends(config.vehicle, config.actuators, config.lidar, config.sensors, cars)


def drawn_parameters(config: RaceConfig) -> dict[str, int]:
    """Return those of a car's parameters that differ between cars: the name of each in a row, its `vehicle` column."""
    low, high = car_ends(config)
    return {name: column for column, name in enumerate(parameter_names()) if low[column] < high[column]}
