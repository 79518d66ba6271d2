"""PPO policies whose mean action stays within [-1, 1].

A Gaussian policy with an unbounded mean is clipped to the action space. Once its mean has drifted well beyond the
bounds, all samples are clipped to the same action, which leaves no gradient: a policy that slowed down while it learned
to steer drives at its lowest speed for ever. With a tanh on the mean, samples always differ.
"""

from __future__ import annotations

from typing import Any

import torch
from sb3_contrib.common.recurrent.policies import RecurrentMultiInputActorCriticPolicy
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from torch import Tensor, nn


class BoundedLinear(nn.Linear):
    """A linear layer followed by tanh."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.tanh(super().forward(input))


class BoundedGaussian(DiagGaussianDistribution):
    """A diagonal Gaussian whose mean is within [-1, 1]."""

    def proba_distribution_net(self, latent_dim: int, log_std_init: float = 0.0) -> tuple[nn.Module, nn.Parameter]:
        log_std = nn.Parameter(torch.ones(self.action_dim) * log_std_init, requires_grad=True)
        return BoundedLinear(latent_dim, self.action_dim), log_std


class BoundedPolicy(MultiInputActorCriticPolicy):
    """PPO's policy with a bounded mean."""

    def _build(self, lr_schedule: Any) -> None:
        self.action_dist = BoundedGaussian(self.action_space.shape[0])  # type: ignore[index]
        super()._build(lr_schedule)


class BoundedRecurrentPolicy(RecurrentMultiInputActorCriticPolicy):
    """RecurrentPPO's policy with a bounded mean."""

    def _build(self, lr_schedule: Any) -> None:
        self.action_dist = BoundedGaussian(self.action_space.shape[0])  # type: ignore[index]
        super()._build(lr_schedule)
