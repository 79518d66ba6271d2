"""A driver that follows the centreline at a steady pace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from outlap.drivers.driver import Driver

WHEELBASE = 0.33  # [m] of a 1:10 car
STEER_STOP = 0.4189  # [rad]


@dataclass(frozen=True)
class CenterlineFollower(Driver):
    """Steers with the curvature just ahead, corrected by offset and heading error.

    The linear feedback is that of a point `1 / offset_gain` long pursuit: stable on any track wide enough for a
    car. Speed is a fixed action, slowed in proportion where the curvature ahead asks for more grip than usual.
    """

    speed_action: float = 0.0  # in [-1, 1]
    offset_gain: float = 0.3  # [rad/m]
    heading_gain: float = 0.9  # [-]
    name: str = "centerline-follower"
    observation_terms: tuple[str, ...] = ("frenet", "curvature_ahead")

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        offset, heading_error = observation["frenet"].T
        ahead = observation["curvature_ahead"]
        steer = np.arctan(WHEELBASE * ahead[:, 0])
        steer = steer - self.offset_gain * offset - self.heading_gain * heading_error
        sharpest = np.abs(ahead[:, :4]).max(axis=1)
        speed = (self.speed_action + 1.0) / np.maximum(1.0, 3.0 * sharpest) - 1.0
        return np.clip(np.stack([steer / STEER_STOP, speed], axis=1), -1.0, 1.0)
