"""What can sit in a car."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Driver(Protocol):
    """Decides for a batch of cars. It knows observations, never an environment."""

    @property
    def name(self) -> str: ...

    @property
    def observation_terms(self) -> tuple[str, ...]:
        """Names of `envs.observations.OBSERVATION_TERMS`."""
        ...

    @property
    def scale_observations(self) -> bool:
        """Whether terms are to be divided by their scale."""
        ...

    def begin(self, cars: np.ndarray) -> None:
        """Hear which cars begin an episode with the next observation: bool (n,). Forget what was before."""
        ...

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Actions in [-1, 1]: (n, 2) steer, speed, from observations (n, size) of n cars."""
        ...
