"""What can sit in a car."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from outlap.errors import OutlapError


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


def ask(driver: Driver, observation: dict[str, np.ndarray], count: int) -> np.ndarray:
    """What a driver does with `count` cars: float32 (count, 2).

    Raises OutlapError that names a driver whose actions are not numbers, not finite, or of a wrong shape.
    """
    answer = driver.act(observation)
    try:
        actions = np.asarray(answer, np.float32)
    except (TypeError, ValueError):
        raise OutlapError(f"driver {driver.name}: gave {answer!r:.60}; must be numbers {(count, 2)}") from None
    if actions.shape != (count, 2):
        raise OutlapError(f"driver {driver.name}: gave actions of shape {actions.shape}; must be {(count, 2)}")
    if not np.isfinite(actions).all():
        wrong = actions[~np.isfinite(actions).all(axis=1)][0]
        raise OutlapError(f"driver {driver.name}: gave the action {wrong.tolist()}; must be finite")
    return actions
