"""Collection of transitions: from the steps of a Stable-Baselines3 `VecEnv` to rows of a replay buffer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from outlap.envs.rewards import CURRICULA
from outlap.envs.sb3_vec_env import SB3VecEnv
from outlap.errors import OutlapError
from outlap.mql.context_vec_env import ContextVecEnv
from outlap.mql.policies import MQLPolicy
from outlap.mql.replay import ReplayBuffer, TaskName

TASK_KEYS = ("task", "track")  # of an `info`: the first that is there names the world's task


def task_of(info: Mapping[str, Any]) -> TaskName:
    """Return the task that an info names, or None. Raises OutlapError for one that cannot be saved."""
    task = next((info[key] for key in TASK_KEYS if key in info), None)
    task = task.item() if isinstance(task, np.generic) else task
    if not isinstance(task, TaskName):
        raise OutlapError(f"replay: a world's task is {task!r:.60}; must be a string, a whole number or None")
    return task


def begin_episodes(buffer: ReplayBuffer, env: VecEnv, observation: Mapping[str, np.ndarray]) -> None:
    """Begin an episode in every world of an environment that was just reset."""
    buffer.begin(np.arange(env.num_envs), observation, [task_of(info) for info in env.reset_infos])


def add_step(
    buffer: ReplayBuffer,
    env: VecEnv,
    observation: Mapping[str, np.ndarray],
    action: np.ndarray,
    reward: np.ndarray,
    dones: np.ndarray,
    infos: Sequence[Mapping[str, Any]],
) -> None:
    """Add what a step of an environment returned; where an episode ended, begin the next.

    Terms of outlap's rewards that have a curriculum are kept unscaled where nothing between the environment and the
    buffer can have changed the reward; other rewards are kept as they are.

    Args:
        buffer: that the rows are added to.
        env: that was stepped.
        observation: (worlds, size) of each term, the next episode's first one where one ended.
        action: (worlds, actions) in [-1, 1].
        reward, dones, infos: as the environment returned them.
    """
    arrived = {name: np.array(value) for name, value in observation.items()}
    terminated = np.zeros(len(dones), bool)
    over = np.flatnonzero(dones)
    for world in over.tolist():
        for name, value in infos[world]["terminal_observation"].items():
            arrived[name][world] = value
        terminated[world] = not infos[world].get("TimeLimit.truncated", False)
    terms: np.ndarray | float = 0.0
    inner = env.venv if isinstance(env, ContextVecEnv) else env
    if isinstance(inner, SB3VecEnv) and buffer.scales.shape == (len(CURRICULA),):
        terms, buffer.scales = inner.env.curriculum_terms, inner.env.curriculum_scales
        reward = reward - terms @ buffer.scales
    buffer.add(np.arange(len(dones)), arrived, action, reward, terminated, terms)
    if len(over):
        first = {name: value[over] for name, value in observation.items()}
        buffer.begin(over, first, [task_of(env.reset_infos[world]) for world in over.tolist()])


class Collector:
    """Drive in the worlds of one task, and keep the transitions."""

    def __init__(self, env: VecEnv, space: gym.spaces.Dict, steps: int, noise: float, rng: np.random.Generator) -> None:
        """Reset the environment.

        Args:
            env: of the task.
            space: observations to keep, with `previous_reward`.
            steps: of each world that there will be at most.
            noise: standard deviation of the exploration noise.
            rng: draws the noise.
        """
        self.env = env if isinstance(env, ContextVecEnv) else ContextVecEnv(env)
        self.noise, self.rng = noise, rng
        actions = self.env.action_space.shape
        assert actions is not None
        # An episode of n transitions has n + 1 rows: at most twice as many rows as steps.
        self.buffer = ReplayBuffer(
            2 * self.env.num_envs * (steps + 2), space, actions[0], self.env.num_envs, curriculum_terms=len(CURRICULA)
        )
        self.observation: Any = self.env.reset()
        begin_episodes(self.buffer, self.env, self.observation)

    def collect(self, policy: MQLPolicy, steps: int) -> None:
        """Add `steps` transitions of each world, driven by a policy."""
        for _ in range(steps):
            action = policy.explore(self.observation, self.buffer, self.noise, self.rng)
            self.observation, reward, dones, infos = self.env.step(policy.unscale_action(action))
            add_step(self.buffer, self.env, self.observation, action, reward, dones, infos)
