"""PPO with domain randomization, and RecurrentPPO: those of Stable-Baselines3 on the batched environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.terminations import TerminationConfig
from outlap.simulator.vehicle import LidarParams, VehicleParams
from outlap.training.config import TrainingConfig

if TYPE_CHECKING:
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.base_class import BaseAlgorithm

CONSTANTS = {
    "n_steps", "batch_size", "n_epochs", "gae_lambda", "clip_range", "ent_coef", "vf_coef", "max_grad_norm",
}  # fmt: skip


class PPOConfig(TrainingConfig):
    """A PPO training. The defaults learn to lap circuits that they never saw within minutes on two cores."""

    policy_name = "MultiInputPolicy"

    algorithm: Literal["ppo"] = "ppo"  # type: ignore[assignment]
    """What trains."""
    env: RaceConfig = RaceConfig(
        augment_tracks=True,
        beams=108,
        control_interval=4,
        speed_range=(1.0, None),  # a car that may stop would rather stand than enter a corner it does not know
        vehicle=VehicleParams(v_max=8.0),
        lidar=LidarParams(noise_std=0.02),
        observation=("scan", "vel", "heading", "previous_action"),
        scale_observations=True,
        termination=TerminationConfig(time_limit=40.0),
        start=StartConfig(speed=(0.0, 6.0), offset=0.8, heading_error=0.3),
    )
    n_steps: int = Field(default=64, ge=2)  # actions per world and rollout
    batch_size: int = Field(default=2048, ge=2)
    n_epochs: int = Field(default=5, ge=1)
    gae_lambda: float = Field(default=0.95, ge=0, le=1)
    clip_range: float = Field(default=0.2, gt=0)
    ent_coef: float = Field(default=0.0, ge=0)
    vf_coef: float = Field(default=0.5, ge=0)
    max_grad_norm: float = Field(default=0.5, gt=0)
    net_arch: tuple[int, ...] = (128, 128)  # of the policy, and of the value function
    activation: Literal["tanh", "relu"] = "tanh"
    log_std_init: float = -0.5  # log of the initial standard deviation of an action
    bounded_mean: bool = False  # keep the mean action within [-1, 1], so that no policy creeps at its lowest speed

    def constants(self) -> dict[str, Any]:
        """See `TrainingConfig`."""
        return super().constants() | self.model_dump(include=CONSTANTS)

    def network(self) -> dict[str, Any]:
        """See `TrainingConfig`: policy and value function."""
        import torch

        return {
            "net_arch": list(self.net_arch),
            "activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[self.activation],
            "log_std_init": self.log_std_init,
        }

    def policy_class(self) -> type[Any]:
        """See `TrainingConfig`."""
        from outlap.drivers.bounded_policy import BoundedPolicy

        return BoundedPolicy if self.bounded_mean else super().policy_class()

    def model_class(self) -> type[BaseAlgorithm]:
        """See `TrainingConfig`."""
        from stable_baselines3 import PPO

        return PPO


class RecurrentPPOConfig(PPOConfig):
    """A training of PPO whose policy and value function share what an LSTM remembers of the episode."""

    policy_name = "MultiInputLstmPolicy"

    algorithm: Literal["recurrent-ppo"] = "recurrent-ppo"  # type: ignore[assignment]
    """What trains."""
    lstm_hidden: int = Field(default=64, ge=1)

    def network(self) -> dict[str, Any]:
        """See `TrainingConfig`."""
        memory = {"lstm_hidden_size": self.lstm_hidden, "shared_lstm": True, "enable_critic_lstm": False}
        return {**super().network(), **memory}

    def policy_class(self) -> type[Any]:
        """See `TrainingConfig`."""
        from outlap.drivers.bounded_policy import BoundedRecurrentPolicy

        return BoundedRecurrentPolicy if self.bounded_mean else TrainingConfig.policy_class(self)

    def model_class(self) -> type[RecurrentPPO]:
        """See `TrainingConfig`."""
        from sb3_contrib import RecurrentPPO

        return RecurrentPPO
