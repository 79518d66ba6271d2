"""The algorithms that `outlap train` offers, by the name in their configuration."""

from __future__ import annotations

from outlap.training.config import TrainingConfig
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig
from outlap.training.recurrent_ppo import RecurrentPPOConfig

ALGORITHMS: dict[str, type[TrainingConfig]] = {
    "ppo": PPOConfig,
    "recurrent-ppo": RecurrentPPOConfig,
    "mql": MQLConfig,
}
