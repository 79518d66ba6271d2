"""A family of toy tasks: a point that shall go to a goal it is not shown."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

STEPS = 20


class HiddenGoal(VecEnv):
    """A point on a line moves by 0.3 a step at most; the reward is minus its distance from a hidden goal.

    The observation is the place alone: only what the steps before were worth tells where the goal is.
    """

    def __init__(self, num_envs: int, low: float, high: float, seed: int = 0) -> None:
        box = gym.spaces.Box(-5.0, 5.0, (1,), np.float32)
        super().__init__(num_envs, box, gym.spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.low, self.high = low, high
        self.rng = np.random.default_rng(seed)
        self.goal, self.place, self.returns = (np.zeros(num_envs) for _ in range(3))
        self.tick = np.zeros(num_envs, np.int64)
        self.actions = np.zeros((num_envs, 1))

    def reset(self) -> np.ndarray:
        self._begin(np.arange(self.num_envs))
        return self._observation()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        self.place = np.clip(self.place + 0.3 * self.actions[:, 0], -3.0, 3.0)
        rewards = -np.abs(self.place - self.goal)
        self.returns += rewards
        self.tick += 1
        dones = self.tick >= STEPS
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        last = self._observation()
        for world in np.flatnonzero(dones).tolist():
            infos[world] = {
                "terminal_observation": last[world],
                "TimeLimit.truncated": True,
                "episode": {"r": float(self.returns[world]), "l": STEPS, "t": 0.0},
            }
        self._begin(np.flatnonzero(dones))
        return self._observation(), rewards.astype(np.float32), dones, infos

    def _begin(self, worlds: np.ndarray) -> None:
        self.goal[worlds] = self.rng.uniform(self.low, self.high, len(worlds))
        for each in (self.place, self.returns, self.tick):
            each[worlds] = 0
        for world in worlds.tolist():
            self.reset_infos[world] = {"task": f"goal {self.goal[world]:.1f}"}

    def _observation(self) -> np.ndarray:
        return self.place[:, None].astype(np.float32)

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        return []

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
