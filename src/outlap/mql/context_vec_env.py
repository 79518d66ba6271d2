"""ContextVecEnv: what Meta-Q-Learning needs to see, around any Stable-Baselines3 `VecEnv`."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from outlap.mql.networks import PREVIOUS_REWARD


class ContextVecEnv(VecEnvWrapper):
    """Observations as a Dict, with the reward of the step before under `previous_reward`.

    A Box observation becomes the term `observation`. What is there already is left as it is.
    """

    def __init__(self, venv: VecEnv) -> None:
        space = venv.observation_space
        self._dict = isinstance(space, gym.spaces.Dict)
        spaces = dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {"observation": space}
        self._adds_reward = PREVIOUS_REWARD not in spaces
        if self._adds_reward:
            spaces[PREVIOUS_REWARD] = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        super().__init__(venv, gym.spaces.Dict(spaces))

    def reset(self) -> VecEnvObs:
        observation = self.venv.reset()
        self.reset_infos = self.venv.unwrapped.reset_infos  # wrappers between do not hand them on
        return self._shown(observation, np.zeros(self.num_envs, np.float32))

    def step_wait(self) -> VecEnvStepReturn:
        observation, rewards, dones, infos = self.venv.step_wait()
        self.reset_infos = self.venv.unwrapped.reset_infos
        for world in np.flatnonzero(dones):
            final = infos[world].get("terminal_observation")
            if final is not None:
                final = dict(final) if self._dict else {"observation": final}
                if self._adds_reward:
                    final[PREVIOUS_REWARD] = rewards[world : world + 1].astype(np.float32)
                infos[world]["terminal_observation"] = final
        return self._shown(observation, np.where(dones, 0.0, rewards)), rewards, dones, infos

    def _shown(self, observation: VecEnvObs, reward: np.ndarray) -> dict[str, np.ndarray]:
        shown = dict(observation) if isinstance(observation, dict) else {"observation": observation}
        if self._adds_reward:
            shown[PREVIOUS_REWARD] = reward[:, None].astype(np.float32)
        return shown  # type: ignore[return-value]
