"""Meta-training with Meta-Q-Learning on the batched environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator
from tyro.conf import arg

from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import RewardConfig
from outlap.mql.config import TD3Config
from outlap.training.config import TrainingConfig
from outlap.training.ppo import PPOConfig

if TYPE_CHECKING:
    from outlap.mql.mql import MQL


class MQLConfig(TrainingConfig, TD3Config):
    """A meta-training. The defaults are for two cores; `--preset paper` has the paper's networks."""

    policy_name = "MQLPolicy"

    algorithm: Literal["mql"] = "mql"  # type: ignore[assignment]
    """What trains."""
    env: RaceConfig = PPOConfig().env.model_copy(
        update={
            "observation": ("scan", "vel", "heading", "previous_action", "previous_reward"),
            # Crashes that cost all from the start teach it to creep.
            "reward": RewardConfig(collision_max=8.4, collision_growth=6 / 7),
        }
    )
    total_steps: Annotated[int, arg(aliases=["--steps"])] = Field(default=3_500_000, gt=0)  # actions, all worlds
    preset: Literal["fast", "paper"] = "fast"  # networks, see mql.networks
    history: int = Field(default=10, ge=1)  # steps that the context is made of
    uses_reward: bool = True  # whether the context observes rewards, which a car does not have
    uses_context: bool = True  # without it, it is TD3
    buffer_size: int = Field(default=1_000_000, ge=1)  # steps, all worlds together
    learning_starts: int = Field(default=20_000, ge=0)  # actions at random before the first update
    batch_size: int = Field(default=256, ge=2)
    updates_per_step: int = Field(default=2, ge=1)  # for every action of all worlds
    n_steps: int = Field(default=3, ge=1)  # of a return

    @field_validator("env")
    @classmethod
    def _observe_rewards(cls, env: RaceConfig) -> RaceConfig:
        # As an observation of the environment, rewards are scaled in a training as in a race.
        if "previous_reward" in env.observation:
            return env
        return env.model_copy(update={"observation": (*env.observation, "previous_reward")})

    @property
    def report_every(self) -> int:
        """See `TrainingConfig`; a rollout is one action of all worlds."""
        return 32 * self.num_envs

    @property
    def log_interval(self) -> int:
        """See `TrainingConfig`: episodes."""
        return self.num_envs

    def constants(self) -> dict[str, Any]:
        """See `TrainingConfig`."""
        return {
            **super().constants(),
            **self.model_dump(include={"buffer_size", "learning_starts", "batch_size", "n_steps"}),
            "train_freq": 1,
            "gradient_steps": self.updates_per_step,
            "td3": TD3Config(**self.model_dump(include=set(TD3Config.model_fields))),
        }

    def network(self) -> dict[str, Any]:
        """See `TrainingConfig`."""
        return self.model_dump(include={"preset", "history", "uses_reward", "uses_context"})

    def model_class(self) -> type[MQL]:
        """See `TrainingConfig`."""
        from outlap.mql.mql import MQL

        return MQL
