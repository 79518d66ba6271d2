"""Policies that have learnt nothing: what they do does not matter, that it is theirs does."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import PPO

from outlap.envs import RaceVectorEnv, SB3VecEnv
from outlap.envs.race_config import RaceConfig
from outlap.track.track import Track


def untrained_ppo(
    config: RaceConfig, track: Track, width: int = 16, seed: int = 0, policy: Any = "MultiInputPolicy"
) -> PPO:
    """A PPO model for a task after a single update, with actions all over their range."""
    env = SB3VecEnv(RaceVectorEnv(2, config, [track]))
    model = PPO(
        policy, env, n_steps=4, batch_size=8, n_epochs=1, seed=seed, device="cpu",
        policy_kwargs={"net_arch": [width, width]},
    )  # fmt: skip
    model.learn(8)
    with torch.no_grad():  # Stable-Baselines3 starts with actions near 0
        model.policy.action_net.weight *= 50.0  # type: ignore[union-attr, operator]
    return model
