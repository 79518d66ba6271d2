"""The fastest speeds along a given line, by forward-backward integration under a friction ellipse.

Along a fixed line the fastest speeds are the largest that satisfy, everywhere, the limits of speed and of cornering,
and from point to point those of accelerating and of braking. From the slowest corner, which nothing can make slower,
one pass forwards finds how fast the car can have become, and one backwards how fast it may be to brake in time (compare
T. Lipp and S. Boyd, Minimum-time speed optimisation over a fixed path, International Journal of Control 87, 2014).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from outlap.planning.limits import CarLimits
from outlap.simulator.bicycle import GRAVITY

LOWEST_SPEED = 0.1  # [m/s] where a line would turn on the spot


def speed_profile(curvature: np.ndarray, spacing: float, limits: CarLimits, mu: ArrayLike | None = None) -> np.ndarray:
    """The fastest speeds around a closed line: (n,) [m/s].

    Args:
        curvature: (n,) [1/m] at equal distances.
        spacing: of the points [m]; accelerations are constant from one to the next.
        limits: of the car.
        mu: friction at each point (n,), in place of the car's.
    """
    friction = np.broadcast_to(np.asarray(limits.mu if mu is None else mu, np.float64), curvature.shape)
    return speed_profiles(curvature, spacing, np.array([motor(limits)]), friction[None])[0]


def motor(limits: CarLimits) -> tuple[float, float, float, float]:
    """A row of `motors`."""
    return limits.a_max, limits.a_brake, limits.v_max, limits.v_switch


def speed_profiles(curvature: np.ndarray, spacing: float, motors: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """`speed_profile` of many cars on one line: (cars, n) [m/s].

    Args:
        curvature: (n,) [1/m].
        spacing: [m].
        motors: (cars, 4): a_max [m/s²], a_brake [m/s²], v_max [m/s], v_switch [m/s].
        mu: (cars, n), or (cars, 1) where it is the same everywhere.
    """
    grip = np.broadcast_to(GRAVITY * np.asarray(mu, np.float64), (len(motors), len(curvature)))
    return _profiles(np.abs(curvature), float(spacing), np.asarray(motors, np.float64), grip)


def lap_time(speed: np.ndarray, spacing: float) -> float:
    """Of a closed line [s], from the speeds (n,) [m/s] at points `spacing` [m] apart, with constant accelerations."""
    return float(np.sum(2.0 * spacing / (speed + np.roll(speed, -1))))


@njit(cache=True, error_model="numpy")
def _profiles(bend, spacing, motors, grip):
    cars, n = grip.shape
    out = np.empty((cars, n))
    for car in range(cars):
        a_max, a_brake, v_max, v_switch = motors[car]
        square = out[car]  # of the speed
        slowest = 0
        for i in range(n):
            cornering = grip[car, i] / max(bend[i], 1e-9)
            square[i] = max(min(cornering, v_max * v_max), LOWEST_SPEED * LOWEST_SPEED)
            if square[i] < square[slowest]:
                slowest = i
        # From the slowest point on, which no pass can make slower, once around.
        for k in range(n):
            i = (slowest + k) % n
            j = (i + 1) % n
            drive = min(a_max, grip[car, i]) * _left_over(square[i] * bend[i] / grip[car, i])
            if square[i] > v_switch * v_switch:
                drive = min(drive, a_max * v_switch / math.sqrt(square[i]))
            square[j] = min(square[j], square[i] + 2.0 * drive * spacing)
        for k in range(n):
            i = (slowest - k) % n
            j = (i - 1) % n
            brake = min(a_brake, grip[car, i]) * _left_over(square[i] * bend[i] / grip[car, i])
            square[j] = min(square[j], square[i] + 2.0 * brake * spacing)
        for i in range(n):
            square[i] = math.sqrt(square[i])
    return out


@njit(cache=True, error_model="numpy")
def _left_over(across):
    """The share of the ellipse's other axis that is left when this share of one is used."""
    return math.sqrt(max(0.0, 1.0 - across * across))
