"""Recording a lap, for a ghost to drive again."""

from __future__ import annotations

import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver, ask
from outlap.envs.race import EGO
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError
from outlap.evaluation.rollout import episode_settings, standing_starts
from outlap.simulator import state as column
from outlap.track.track import Track


def record_lap(driver: Driver, env: RaceConfig, track: Track, seed: int = 0) -> np.ndarray:
    """The first flying lap of a driver alone on a track: (n, 5), see `drivers.ghost.COLUMNS`, a row an action.

    Raises OutlapError where the driver does not complete it.
    """
    alone = standing_starts(env.model_copy(update={"num_cars": 1}), [track], laps=1)
    race = RaceVectorEnv(1, **episode_settings(driver, alone, track), autoreset_mode=AutoresetMode.DISABLED)
    observation, info = race.reset(seed=seed)
    driver.begin(np.ones(1, bool))
    worlds, lap = race.race.worlds, []
    while True:
        observation, _, terminated, truncated, info = race.step(ask(driver, observation, 1))
        begun = worlds.lap_start[0, EGO]
        if not (np.isnan(begun) or worlds.laps[0, EGO]):
            state = worlds.state[0, EGO]
            lap.append([worlds.time[0] - begun, *state[[column.X, column.Y, column.YAW, column.SPEED]]])
        if terminated[0] or truncated[0]:
            if worlds.laps[0, EGO] == 0:
                raise OutlapError(
                    f"driver {driver.name}: completed no lap of {track.name} ({info['outcome'][0]} after "
                    f"{info['progress_m'][0]:.0f} m); try another --seed, or another driver"
                )
            return np.array(lap)
