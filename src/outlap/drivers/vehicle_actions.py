"""From what a driver wants of a car to actions, by the observation term `action_span`."""

from __future__ import annotations

import numpy as np

WHEELBASE = 0.33  # [m] of a 1:10 car


def steer_action(curvature: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Steering that drives an arc slowly: (n,) in [-1, 1] from its curvature [1/m], left positive."""
    return np.clip(np.arctan(WHEELBASE * curvature) / span[:, 0], -1.0, 1.0)


def speed_action(speed: np.ndarray, span: np.ndarray) -> np.ndarray:
    """The action that commands a speed, or the nearest that can be: (n,) in [-1, 1] from [m/s]."""
    slowest, fastest = span[:, 1], span[:, 2]
    return np.clip(2.0 * (speed - slowest) / np.maximum(fastest - slowest, 1e-6) - 1.0, -1.0, 1.0)
