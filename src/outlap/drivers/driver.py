"""What can sit in a car."""

from __future__ import annotations

from typing import Any, Protocol

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
    """What a driver does with `count` cars: float32 (count, 2) in [-1, 1].

    Raises OutlapError that names a driver whose actions are not numbers, not finite, or of a wrong shape.
    """
    return checked_actions(driver.act(observation), (count, 2), f"driver {driver.name}: gave")


def checked_actions(answer: Any, shape: tuple[int, ...], who: str) -> np.ndarray:
    """Actions from outside, clipped to [-1, 1]: float32.

    Args:
        answer: what was given for actions.
        shape: that they must have, (..., 2).
        who: gave them, to begin an error with.

    Raises OutlapError for what is not numbers, has another shape, or is NaN or infinite.
    """
    try:
        actions = np.asarray(answer)
    except ValueError:  # rows of unequal lengths
        actions = np.array(None)
    if actions.dtype.kind not in "fiub":
        raise OutlapError(f"{who} {answer!r:.60}; must be numbers {shape}")
    if actions.shape != shape:
        raise OutlapError(f"{who} actions of shape {actions.shape}; must be {shape}")
    finite = np.isfinite(actions).all(axis=-1)
    if not finite.all():
        row = int(np.argmin(finite))
        where = f" (row {row})" if len(shape) > 1 else ""
        raise OutlapError(f"{who} the action {np.atleast_2d(actions)[row].tolist()}; must be finite{where}")
    return np.clip(actions, -1.0, 1.0).astype(np.float32, copy=False)
