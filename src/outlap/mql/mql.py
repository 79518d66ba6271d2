"""MQL: Meta-Q-Learning (Fakoor et al., 2020) as a Stable-Baselines3 off-policy algorithm.

TD3 over many tasks at once, its actor and critics conditioned on a context of the last steps; the context's encoder is
trained with them. Adapting to a task afterwards: `adaptation.adapt`.
"""

from __future__ import annotations

import os
from collections import defaultdict
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from outlap.envs.rewards import CURRICULA
from outlap.errors import OutlapError
from outlap.mql.batch import Batch
from outlap.mql.collector import add_step, begin_episodes
from outlap.mql.config import TD3Config
from outlap.mql.context_vec_env import ContextVecEnv
from outlap.mql.learner import td3_update
from outlap.mql.policies import MQLPolicy
from outlap.mql.replay import ReplayBuffer


class MQL(OffPolicyAlgorithm):
    """Meta-training. Any `VecEnv` will do; its infos tell each world's task, and its observation is a Dict or a Box."""

    policy: MQLPolicy
    policy_aliases = {"MQLPolicy": MQLPolicy}  # noqa: RUF012 - as the base class has it
    replay_buffer: ReplayBuffer  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[MQLPolicy] = "MQLPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 10_000,
        batch_size: int = 256,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        n_steps: int = 1,
        td3: TD3Config | None = None,
        by_task: bool = True,
        task_buffer_size: int | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        _init_setup_model: bool = True,
        **logging_and_device: Any,
    ) -> None:
        """Set up.

        Args:
            policy: the policy class.
            env: to learn from; it is wrapped in `ContextVecEnv`.
            learning_rate: of all networks, or a function of the progress remaining (1 … 0).
            buffer_size: steps of all worlds that the replay keeps.
            learning_starts: steps of all worlds with random actions before the first update.
            batch_size: transitions of an update.
            gamma: discount of a step.
            train_freq: steps of the vector environment between updates.
            gradient_steps: updates then; -1: as many as steps.
            n_steps: steps of a transition.
            td3: constants of the update.
            by_task: draw every task as often as any other, and not every transition.
            task_buffer_size: newest transitions of a task that are drawn; None: all that are kept.
            policy_kwargs: see `MQLPolicy`: preset, history, uses_reward, uses_context.
            seed: of everything that is drawn.
            logging_and_device: see Stable-Baselines3: stats_window_size, tensorboard_log, verbose, device.
        """
        self.td3 = td3 or TD3Config()
        super().__init__(
            policy, env, learning_rate, buffer_size, learning_starts, batch_size, self.td3.tau, gamma, train_freq,  # type: ignore[arg-type]
            gradient_steps, n_steps=n_steps, policy_kwargs=policy_kwargs, seed=seed, sde_support=False,
            support_multi_env=True, **logging_and_device,
        )  # fmt: skip
        self.by_task = by_task
        self.task_buffer_size = task_buffer_size
        self._n_updates = 0
        if _init_setup_model:
            self._setup_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        return wrapped if isinstance(wrapped, ContextVecEnv) else ContextVecEnv(wrapped)

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.replay_buffer = ReplayBuffer(
            self.buffer_size, self.observation_space, self.action_space.shape[0], self.n_envs,  # type: ignore[arg-type, index]
            task_capacity=self.task_buffer_size, curriculum_terms=len(CURRICULA),
        )  # fmt: skip
        self.policy = self.policy_class(
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        ).to(self.device)  # type: ignore[assignment]
        self._convert_train_freq()

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all that is drawn from here on, the environment at its next reset too; None: at random."""
        super().set_random_seed(seed)
        first, second = np.random.SeedSequence(seed).spawn(2)
        self._rng = np.random.default_rng(first)  # batches and exploration
        self._noise = torch.Generator(self.device).manual_seed(int(second.generate_state(1)[0]))  # target actions

    def _setup_learn(self, *args: Any, **kwargs: Any):
        before = self._last_obs
        done = super()._setup_learn(*args, **kwargs)
        if self._last_obs is not before:  # every world was reset
            assert self.env is not None
            assert isinstance(self._last_obs, dict)
            begin_episodes(self.replay_buffer, self.env, self._last_obs)
        return done

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.num_timesteps < learning_starts:
            size = (n_envs, self.action_space.shape[0])  # type: ignore[index]
            scaled = self._rng.uniform(-1.0, 1.0, size).astype(np.float32)
        else:
            assert isinstance(self._last_obs, dict)
            scaled = self.policy.explore(self._last_obs, self.replay_buffer, self.td3.exploration_noise, self._rng)
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(self, replay_buffer, buffer_action, new_obs, reward, dones, infos) -> None:
        assert self.env is not None
        assert isinstance(new_obs, dict)
        add_step(self.replay_buffer, self.env, new_obs, buffer_action, reward, dones, infos)
        self._last_obs = new_obs

    def draw(self, buffer: ReplayBuffer, size: int, rng: np.random.Generator, *, by_task: bool = False) -> Batch:
        """Transitions of a buffer as this model learns from them: its history, n-step returns and discount."""
        return buffer.gather(
            buffer.sample(size, rng, by_task=by_task), history=self.policy.history, n_steps=self.n_steps,
            gamma=self.gamma, terms=self.policy.window_terms,
        )  # fmt: skip

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Make `gradient_steps` updates from the replay."""
        policy = self.policy
        policy.set_training_mode(True)
        rate = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
        for optimizer in (policy.actor_optimizer, policy.critic_optimizer):
            update_learning_rate(optimizer, rate)
        records: dict[str, list[torch.Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.draw(self.replay_buffer, batch_size, self._rng, by_task=self.by_task)
            update_actor = self._n_updates % self.td3.policy_delay == 0
            for name, value in td3_update(policy, batch, self.td3, self._noise, update_actor=update_actor).items():
                records[name].append(value)
        for name, values in records.items():
            mean = torch.stack(values).mean().item()
            if not np.isfinite(mean):
                raise OutlapError(
                    f"training: {name} is {mean} after {self._n_updates} updates; lower the learning rate"
                )
            self.logger.record(f"train/{name}", mean)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def save_replay_buffer(self, path: str | os.PathLike[str]) -> None:  # type: ignore[override]
        """Write the replay, see `ReplayBuffer.save`."""
        self.replay_buffer.save(path)

    def load_replay_buffer(self, path: str | os.PathLike[str], truncate_last_traj: bool = True) -> None:  # type: ignore[override]
        """Take up a replay that `save_replay_buffer` wrote, of any number of worlds; see `ReplayBuffer.load`."""
        self.replay_buffer = ReplayBuffer.load(path)  # pyright: ignore[reportIncompatibleVariableOverride]
        self.replay_buffer.forget_worlds(self.n_envs)
        self._last_obs = None  # so that `learn` begins new episodes

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rng", "_noise"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.actor_optimizer", "policy.critic_optimizer"], []
