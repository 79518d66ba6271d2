"""What can sit in a car."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Driver(Protocol):
    """Decides for a batch of cars. It knows observations, never an environment."""

    name: str
    observation_terms: tuple[str, ...]  # names of `envs.observations.OBSERVATION_TERMS`
    scale_observations: bool  # whether terms are to be divided by their scale

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Actions in [-1, 1]: (n, 2) steer, speed, from observations (n, size) of n cars."""
        ...
