"""PPO with a memory: sb3-contrib's RecurrentPPO on the batched environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from outlap.training.ppo import PPOConfig

if TYPE_CHECKING:
    from sb3_contrib import RecurrentPPO


class RecurrentPPOConfig(PPOConfig):
    """A training of PPO whose policy and value function share what an LSTM remembers of the episode."""

    policy_name = "MultiInputLstmPolicy"

    algorithm: Literal["recurrent-ppo"] = "recurrent-ppo"  # type: ignore[assignment]
    lstm_hidden: int = Field(default=64, ge=1)

    def network(self) -> dict[str, Any]:
        """See `TrainingConfig`."""
        memory = {"lstm_hidden_size": self.lstm_hidden, "shared_lstm": True, "enable_critic_lstm": False}
        return {**super().network(), **memory}

    def model_class(self) -> type[RecurrentPPO]:
        """See `TrainingConfig`."""
        from sb3_contrib import RecurrentPPO

        return RecurrentPPO
