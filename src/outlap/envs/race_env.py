"""RaceEnv: one race as a `gymnasium.Env`: the vector environment with one world."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError


class RaceEnv(gym.Env):
    """One race. Spaces, keywords and `info` are those of a world of `RaceVectorEnv`.

    `lap_time_s` and `last_lap_time_s` come into `info` with the first completed lap.
    """

    def __init__(self, **config: Any) -> None:
        for name in ("num_envs", "autoreset_mode"):
            if name in config:
                raise OutlapError(f"{name}: a single race has none; take gymnasium.make_vec or RaceVectorEnv")
        self._env = RaceVectorEnv(1, autoreset_mode=AutoresetMode.DISABLED, **config)
        self.config = self._env.config
        self.observation_space = self._env.single_observation_space
        self.action_space = self._env.single_action_space
        self.metadata = {"render_modes": [], "render_fps": self._env.metadata["render_fps"]}
        self.render_mode = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; a seed starts the stream of episodes anew."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed)
        return _only(observation), _only(info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out an action (2,) in [-1, 1]: steering, speed."""
        observation, reward, terminated, truncated, info = self._env.step(np.asarray(action)[None])
        return _only(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _only(info)


def _only(batch: dict[str, Any]) -> dict[str, Any]:
    """The one world's values; masks, and what they say is not known, left out."""
    known = {name: value for name, value in batch.items() if not name.startswith("_") and batch.get(f"_{name}", [1])[0]}
    values = {name: value[0] for name, value in known.items()}
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
