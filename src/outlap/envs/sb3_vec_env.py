"""SB3VecEnv: the vector environment as Stable-Baselines3 wants it; the only list-of-dict code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from outlap.envs.episodes import EPISODE_FIELDS, REWARD_PREFIX
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError

# Of every world at every step; the rest of the information is given when an episode ends.
EVERY_STEP = ("track", "task")


class SB3VecEnv(VecEnv):
    """The worlds of a `RaceVectorEnv` for Stable-Baselines3.

    The `infos` of a world whose episode just ended hold its `outcome`, every reward term, `terminal_observation`,
    `TimeLimit.truncated`, and `episode`: `r`, `l`, `t`, `outcome`, all of `EPISODE_FIELDS`, every reward term.
    """

    def __init__(self, env: RaceVectorEnv) -> None:
        """Wrap an environment, whose autoreset mode must be SAME_STEP."""
        if env.autoreset_mode != AutoresetMode.SAME_STEP:
            raise OutlapError(f"autoreset_mode is {env.autoreset_mode}; Stable-Baselines3 knows only SAME_STEP")
        self.env = env
        self.render_mode = None
        self._actions = np.zeros((env.num_envs, 2), np.float32)
        super().__init__(  # pyright: ignore[reportUnknownMemberType]
            env.num_envs, env.single_observation_space, env.single_action_space
        )

    def reset(self) -> dict[str, np.ndarray]:
        """Begin an episode in every world, with the seeds that `seed` set."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        observation, info = self.env.reset(seed=seeds)
        self.reset_infos = [self._world_info(info, world) for world in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (worlds, 2) of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Make the step."""
        observation, rewards, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        infos = [self._world_info(info, world) for world in range(self.num_envs)]
        for world in np.flatnonzero(done):
            self.reset_infos[world] = infos[world]  # of the episode that begins
            final = {name: info["final_info"][name][world] for name in info["final_info"] if name[0] != "_"}
            infos[world] = {
                **final,
                "episode": {
                    "r": float(final["episode_return"]),
                    "l": int(final["episode_steps"]),
                    "t": float(final["time_s"]),
                    "outcome": str(final["outcome"]),
                    **{name: float(value) for name, value in final.items() if _is_statistic(name)},
                },
                "terminal_observation": info["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world]),
            }
        return observation, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing is open."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vector environment, once a world."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, which all worlds share."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the vector environment, which acts on all worlds; its result once a world."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Worlds have no wrappers of their own."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """None: races are looked at through outlap's viewers."""
        return [None] * self.num_envs

    @staticmethod
    def _world_info(info: dict[str, Any], world: int) -> dict[str, Any]:
        return {name: info[name][world] for name in EVERY_STEP}


def _is_statistic(name: str) -> bool:
    return name in EPISODE_FIELDS or name.startswith(REWARD_PREFIX)
