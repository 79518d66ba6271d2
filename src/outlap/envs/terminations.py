"""How an episode ends: a function an outcome. A crash terminates; the others truncate."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from outlap.config import Config
from outlap.envs.race import RUNNING, Race

CRASH, FINISHED, TIMEOUT, STALLED = "crash", "finished", "timeout", "stalled"


class TerminationConfig(Config):
    """When an episode ends without a crash. 0 switches a rule off."""

    time_limit: float = Field(default=60.0, ge=0)  # [s]
    laps: int = Field(default=0, ge=0)  # completed, from line to line
    stall_time: float = Field(default=3.0, ge=0)  # without getting ahead by `stall_distance` [s]
    stall_distance: float = Field(default=0.3, gt=0)  # [m]


def finished(race: Race, car: int, config: TerminationConfig) -> np.ndarray:
    """The car has done its laps: bool (worlds,)."""
    return (race.worlds.laps[:, car] >= config.laps) & (config.laps > 0)


def timeout(race: Race, car: int, config: TerminationConfig) -> np.ndarray:
    """The time limit is reached: bool (worlds,)."""
    return (race.worlds.time >= config.time_limit - 1e-9) & (config.time_limit > 0)


def stalled(race: Race, car: int, config: TerminationConfig) -> np.ndarray:
    """The car stands, reverses or circles: no new ground for a while: bool (worlds,)."""
    return (race.worlds.time - race.farthest_time[:, car] >= config.stall_time - 1e-9) & (config.stall_time > 0)


def outcomes(race: Race, car: int, config: TerminationConfig) -> np.ndarray:
    """The outcome of each world's episode for a car, RUNNING while it goes on: str (worlds,)."""
    rules = [race.crashed[:, car], finished(race, car, config), timeout(race, car, config), stalled(race, car, config)]
    return np.select(rules, [CRASH, FINISHED, TIMEOUT, STALLED], default=RUNNING)
