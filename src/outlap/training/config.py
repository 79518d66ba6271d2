"""TrainingConfig: what the trainings of all algorithms have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, field_validator
from tyro.conf import arg

from outlap.config import Config
from outlap.envs.car_sets import is_test_split
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError, brief

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from outlap.envs.sb3_vec_env import SB3VecEnv

RECENT_EPISODES = 500  # over which training statistics are taken; a checkpoint keeps them


class TrainingConfig(Config):
    """A training. Each algorithm has its own, named by the field `algorithm`."""

    policy_name: ClassVar[str]  # of the networks, as the algorithm calls them

    algorithm: str
    env: RaceConfig = RaceConfig()
    held_out_tracks: tuple[str, ...] = ()  # what `outlap evaluate` takes by default; refused if also trained on
    total_steps: Annotated[int, arg(aliases=["--steps"])] = Field(default=2_000_000, gt=0)  # actions, all worlds
    num_envs: int = Field(default=128, ge=1)
    seed: int = Field(default=0, ge=0)
    learning_rate: float = Field(default=5e-4, gt=0)
    learning_rate_decay: bool = True  # linearly to zero at total_steps
    gamma: float = Field(default=0.99, gt=0, le=1)
    device: str = "cpu"  # of PyTorch: cpu, cuda, cuda:1, or auto for a GPU if there is one
    threads: int = Field(default=0, ge=0)  # of PyTorch; 0 = one a core
    checkpoint_every: int = Field(default=250_000, gt=0)  # actions

    @field_validator("env")
    @classmethod
    def _held_out_opponents_are_for_evaluation(cls, env: RaceConfig) -> RaceConfig:
        if env.opponent_split != "train":
            raise ValueError("opponent_split is 'held_out'; must be 'train': no training meets the held-out half")
        return env

    @field_validator("env")
    @classmethod
    def _test_cars_are_for_evaluation(cls, env: RaceConfig) -> RaceConfig:
        if is_test_split(env.cars):
            raise ValueError(f"cars is {env.cars!r}; must not be a split of test cars: train on 'training' or a file")
        return env

    @abstractmethod
    def model_class(self) -> type[BaseAlgorithm]:
        """The algorithm."""

    def policy_class(self) -> type[Any]:
        """The class of its networks."""
        return self.model_class().policy_aliases[self.policy_name]

    def constants(self) -> dict[str, Any]:
        """Return the arguments of the algorithm, except for its networks."""
        return {
            **self.model_dump(include={"gamma", "seed", "device"}),
            "learning_rate": self.schedule(),
            "stats_window_size": RECENT_EPISODES,
        }

    @abstractmethod
    def network(self) -> dict[str, Any]:
        """What the networks are built with."""

    def make_model(self, environment: SB3VecEnv) -> BaseAlgorithm:
        """A model that has learnt nothing yet."""
        networks = {"policy_kwargs": self.network()}
        return self.model_class()(self.policy_class(), environment, **self.constants(), **networks)  # type: ignore[arg-type]

    @property
    def report_every(self) -> int:
        """Actions between two reports of progress, at the end of a rollout."""
        return 0

    @property
    def log_interval(self) -> int:
        """Of `learn`: between two lines of the log, in the algorithm's own count."""
        return 1

    def schedule(self) -> Callable[[float], float] | float:
        """The learning rate as a function of the progress remaining, 1 … 0."""
        rate = self.learning_rate
        return (lambda remaining: rate * remaining) if self.learning_rate_decay else rate


def check_device(device: str) -> None:
    """Raises OutlapError for a device that PyTorch does not know, or that this machine does not have.

    Stable-Baselines3 takes the CPU then, and says nothing.
    """
    import torch

    if device == "auto":  # a GPU if there is one
        return
    try:
        torch.empty(1, device=device).cpu()
    except Exception as error:  # RuntimeError, AssertionError, NotImplementedError: that hangs on the device
        raise OutlapError(
            f"device is {device!r}: {brief(error)}; must be cpu, auto, or a device that PyTorch has here, such as cuda"
        ) from error
