"""Driver: decides for the cars that it sits in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import gymnasium as gym

    from outlap.config import Config

PAPER_TERMS = ("scan", "pose", "vel", "heading")


class Driver(ABC):
    """Map the observations of a batch of cars to actions. A driver knows observations, never an environment.

    A subclass sets `name` and `observation_terms`, implements `act`, and overrides what else it has.
    """

    name: str
    observation_terms: tuple[str, ...]  # names in `envs.observations.OBSERVATION_TERMS`
    scale_observations: bool = False  # whether each term is divided by its scale
    beams: int | None = None  # of the scan that it needs; None: any number
    speeds: tuple[float, float] | None = None  # [m/s] that its actions -1 and 1 command; None: those of the car
    reward: Config | None = None  # the RewardConfig whose rewards it observes; None: the task's
    architecture: Hashable = None  # drivers of equal architectures can be stacked; None: this one cannot

    def begin(self, cars: np.ndarray) -> None:
        """Forget the past of cars whose episode begins with the next observation: bool (n,)."""
        return

    @abstractmethod
    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return actions in [-1, 1], (n, 2) steer and speed, for observation terms (n, size) of n cars."""

    def context(self) -> np.ndarray | None:
        """Return the context behind the last actions, (n, hidden), for a driver that infers one."""
        return None

    def check(self, space: gym.Space) -> None:
        """Raise OutlapError if observations of a space are not those that the driver needs."""
        return

    @classmethod
    def stack(cls, drivers: Sequence[Any]) -> DriverStack:
        """Return drivers of one `architecture` as one batch."""
        raise NotImplementedError(f"{cls.__name__} has no architecture")


class DriverStack(ABC):
    """Drivers without memory that act together, in one batch."""

    @abstractmethod
    def act(self, which: np.ndarray, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return actions (n, 2) of n cars, given the number of each car's driver, int (n,)."""


@dataclass(frozen=True)
class FunctionDriver(Driver):
    """Asks a function for the actions of all cars at once: observation terms (n, size) in, actions (n, 2) out."""

    function: Callable[[dict[str, np.ndarray]], Any]
    name: str
    observation_terms: tuple[str, ...] = PAPER_TERMS

    @classmethod
    def of(cls, function: Callable[[dict[str, np.ndarray]], Any]) -> FunctionDriver:
        """A function as it is: of the paper's terms, or of those that its attribute `observation_terms` names."""
        terms = getattr(function, "observation_terms", PAPER_TERMS)
        terms = (terms,) if isinstance(terms, str) else tuple(terms)
        return cls(function, getattr(function, "__name__", type(function).__name__), terms)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        return self.function(observation)
