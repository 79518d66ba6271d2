"""MQLPolicy: actor, critics and context encoder, and how they act with a memory of the last steps."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor

from outlap.errors import OutlapError
from outlap.mql.batch import Windows
from outlap.mql.networks import PRESETS, PREVIOUS_REWARD, windows_from
from outlap.mql.replay import ReplayBuffer


@dataclass
class Memory:
    """What `predict` knows of the steps before: hand it back as `state`."""

    history: ReplayBuffer
    action: np.ndarray  # (n, actions) chosen last


class MQLPolicy(BasePolicy):
    """Deterministic actor and twin critics conditioned on a context z of the last steps."""

    def __init__(
        self,
        observation_space: gym.spaces.Dict,
        action_space: gym.spaces.Box,
        lr_schedule: Schedule,
        preset: str = "fast",
        history: int | None = None,
        uses_reward: bool = True,
        uses_context: bool = True,
    ) -> None:
        """Build the networks.

        Args:
            observation_space: Dict of one-dimensional terms; `previous_reward` is for the context alone.
            action_space: Box.
            lr_schedule: of both optimizers.
            preset: a name of `networks.PRESETS`.
            history: steps that the context is made of; by default the preset's.
            uses_reward: whether the context is told the rewards.
            uses_context: False gives plain TD3: z is 0.

        Raises OutlapError for an unknown preset, or rewards that the observation does not hold.
        """
        super().__init__(observation_space, action_space)
        if preset not in PRESETS:
            raise OutlapError(f"preset is {preset!r}; must be one of {', '.join(PRESETS)}")
        if uses_reward and PREVIOUS_REWARD not in observation_space.spaces:
            raise OutlapError(f"observation: has no term {PREVIOUS_REWARD!r}; add it, or set uses_reward to false")
        self._spaces = observation_space.spaces
        self._actions = action_space.shape[0]
        shape = PRESETS[preset]()
        self.preset, self.uses_reward, self.uses_context = preset, uses_reward, uses_context
        self.history = history or shape.history
        self.context_terms = shape.context_terms(observation_space)
        self.window_terms = (PREVIOUS_REWARD, *self.context_terms) if uses_reward else self.context_terms
        self.context, self.actor, self.critic = shape.build(observation_space, self._actions, uses_reward, self.history)
        # Copied together, so that an encoder which both share stays shared.
        self.actor_target, self.critic_target = copy.deepcopy((self.actor, self.critic))
        self.actor_target.requires_grad_(False)
        self.critic_target.requires_grad_(False)
        self.shares_encoder = shape.shared_encoder
        # Parameters of the targets and those that they follow, in the same order; what actor and critics share once.
        self.targets: list[Tensor] = list(torch.nn.ModuleList([self.actor_target, self.critic_target]).parameters())
        self.followed: list[Tensor] = list(torch.nn.ModuleList([self.actor, self.critic]).parameters())
        self.make_optimizers(lr_schedule(1.0))

    def make_optimizers(self, learning_rate: float) -> None:
        """New optimizers; the context belongs to the critics' one, and is trained by both losses."""
        ours = self.actor.head if self.shares_encoder else self.actor
        critics = [*self.critic.parameters(), *self.context.parameters()]
        self.actor_optimizer = torch.optim.Adam(ours.parameters(), learning_rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(critics, learning_rate, fused=True)

    def adapted_parameters(self) -> list[torch.nn.Parameter]:
        """What learning changes: actor, critics and context, each once."""
        return [
            p
            for optimizer in (self.actor_optimizer, self.critic_optimizer)
            for p in optimizer.param_groups[0]["params"]
        ]

    def steps(self, windows: Windows) -> Tensor:
        """Return what the context encoder reads of windows, (length, n, inputs)."""
        if not self.shares_encoder and tuple(windows.columns) == self.window_terms:
            return windows.steps
        embed = self.critic.encoder.encoders if self.shares_encoder else {}
        rows = windows.steps.flatten(0, 1)
        terms = {name: rows[:, windows.columns[name]] for name in self.window_terms}
        read = [embed[name](term) if name in embed else term for name, term in terms.items()]
        return torch.cat([rows[:, : self._actions], *read], -1).unflatten(0, windows.valid.shape)

    def encode(self, windows: Windows) -> Tensor:
        """Return the context z (n, hidden) at the end of each window."""
        if not self.uses_context:
            return torch.zeros(windows.valid.shape[1], self.context.hidden, device=self.device)
        windows = windows.to(self.device)
        return self.context(self.steps(windows), windows.valid)

    def contexts(self, windows: Windows, later: Tensor) -> tuple[Tensor, Tensor]:
        """Return the context z (n, hidden) of two windows that share rows, which are embedded once.

        Args:
            windows: of more than `history` rows.
            later: int64 (n,) the row where the second window begins; the first one begins at row 0.

        Returns:
            z of the first window, and that of the second, without gradient.
        """
        if not self.uses_context:
            zero = self.encode(windows)
            return zero, zero
        steps, length = self.steps(windows), self.history
        context = self.context(steps[:length], windows.valid[:length])
        with torch.no_grad():
            arrival = (windows_from(rows, later, length) for rows in (steps, windows.valid))
            return context, self.context(*arrival)

    def act(self, observation: Mapping[str, np.ndarray], windows: Windows) -> np.ndarray:
        """Actions in [-1, 1], (n, actions), without noise."""
        with torch.no_grad():
            seen = {
                name: torch.as_tensor(observation[name], dtype=torch.float32, device=self.device)
                for name in self.actor.encoder.encoders
            }
            return self.actor(self.actor.encoder(seen), self.encode(windows)).cpu().numpy()

    def explore(
        self, observation: Mapping[str, np.ndarray], history: ReplayBuffer, noise: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Actions in [-1, 1] with Gaussian noise of a standard deviation, float32 (n, actions).

        Args:
            observation: (n, size) of each term, of all worlds of `history`.
            history: whose newest rows they are.
            noise: standard deviation.
            rng: draws the noise.
        """
        chosen = self.act(observation, history.windows(history.latest, self.history, self.window_terms))
        return np.clip(chosen + noise * rng.standard_normal(chosen.shape), -1.0, 1.0).astype(np.float32)

    def predict(  # type: ignore[override]
        self,
        observation: dict[str, np.ndarray],
        state: Memory | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Memory]:
        """Actions, and the memory to hand back at the next step.

        Args:
            observation: (n, size) of each term, or (size,) of one car.
            state: what the call before returned; None where every car begins an episode.
            episode_start: bool (n,): cars whose episode begins with this observation.
            deterministic: the policy has no other way to act.
        """
        given = observation if isinstance(observation, dict) else {}
        if missing := [name for name in self.window_terms if name not in given]:
            raise OutlapError(f"MQLPolicy: is not shown {missing[0]!r}; put its environment into a ContextVecEnv")
        single = next(iter(observation.values())).ndim == 1
        if single:
            observation = {name: value[None] for name, value in observation.items()}
        observation = {name: observation[name] for name in self._spaces if name in observation}
        n = len(next(iter(observation.values())))
        begins = np.ones(n, bool) if state is None or episode_start is None else np.asarray(episode_start, bool)
        if state is None:
            state = Memory(self._new_history(n), np.zeros((n, self._actions), np.float32))
        elif episode_start is None:
            begins = np.zeros(n, bool)
        on, new = np.flatnonzero(~begins), np.flatnonzero(begins)
        if len(on):
            kept = {name: value[on] for name, value in observation.items()}
            state.history.add(on, kept, state.action[on], np.zeros(len(on)), np.zeros(len(on), bool))
        if len(new):
            state.history.begin(new, {name: value[new] for name, value in observation.items()}, [None] * len(new))
        windows = state.history.windows(state.history.latest, self.history, self.window_terms)
        chosen = self.act(observation, windows)
        state = Memory(state.history, chosen)
        actions = self.unscale_action(chosen)
        return (actions[0] if single else actions), state

    def context_of(self, memory: Memory) -> np.ndarray:
        """The context z (n, hidden) that the last actions were chosen with."""
        history = memory.history
        with torch.no_grad():
            return self.encode(history.windows(history.latest, self.history, self.window_terms)).cpu().numpy()

    def _new_history(self, n: int) -> ReplayBuffer:
        spaces = {name: box for name, box in self._spaces.items() if name in self.window_terms}
        return ReplayBuffer((self.history + 2) * n, gym.spaces.Dict(spaces), self._actions, n)

    def forward(self, observation: Any, deterministic: bool = True) -> Tensor:
        return self._predict(observation, deterministic)

    def _predict(self, observation: Any, deterministic: bool = True) -> Tensor:
        raise OutlapError("MQLPolicy acts with a memory: call predict with the state that it returned before")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            lr_schedule=lambda _: 0.0,  # optimizers are restored by the algorithm
            preset=self.preset, history=self.history, uses_reward=self.uses_reward, uses_context=self.uses_context,
        )  # fmt: skip
        return data
