"""Pure pursuit of the racing line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from outlap.drivers.driver import Driver
from outlap.drivers.vehicle_actions import WHEELBASE, speed_action, steer_action


@dataclass(frozen=True)
class PurePursuit(Driver):
    """Drives the arc through a point of the racing line ahead, at the line's speed (Coulter, 1992).

    The point is farther ahead the faster the car is, and the farther it is from the line. At the limit of grip a car
    slides: the arc begins in its direction of travel, not along its nose; understeer is made up for, and what the yaw
    rate lacks of the arc's is steered too, which catches the tail that braking makes light. Farther from the line it
    drives no faster than a gentle arc back allows. The line is the environment's `racing_line`.
    """

    lookahead: float = 0.4  # [m] at a standstill
    lookahead_time: float = 0.12  # [s] more for every m/s
    lookahead_per_offset: float = 4.0  # [m] more for every metre from the line beyond
    near: float = 0.3  # [m]
    return_acceleration: float = 3.0  # across, on the way back to the line from farther away [m/s²]
    understeer: float = 0.0028  # steering more for every m/s² across [rad s²/m]: what the default car's tyres ask for
    yaw_rate_gain: float = 0.18  # steering for what the yaw rate lacks [s]
    speed_share: float = 1.0  # of the line's speed
    preview_time: float = 0.1  # [s] ahead from where the speed is taken: what the car takes to follow a command
    name: str = "pure-pursuit"
    observation_terms: tuple[str, ...] = ("line_ahead", "vel", "action_span")

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        line = observation["line_ahead"].reshape(len(observation["vel"]), -1, 3)
        forward, leftward, yaw_rate = observation["vel"].T
        forward = np.maximum(forward, 0.0)
        slip = np.arctan2(leftward, np.maximum(forward, 1.0))[:, None]  # of a car that stands: none
        x = np.cos(slip) * line[..., 0] + np.sin(slip) * line[..., 1]
        y = np.cos(slip) * line[..., 1] - np.sin(slip) * line[..., 0]
        away = np.hypot(x, y)
        offset = np.maximum(away.min(axis=1) - self.near, 0.0)
        distance = self.lookahead + self.lookahead_time * forward + self.lookahead_per_offset * offset
        target_x, target_y = (_where_reached(away, values, distance) for values in (x, y))
        curvature = 2.0 * target_y / np.maximum(target_x**2 + target_y**2, 1e-6)
        lacking = forward * curvature - yaw_rate
        more = self.understeer * forward**2 * curvature + self.yaw_rate_gain * lacking
        speed = self.speed_share * _where_reached(away, line[..., 2], self.preview_time * forward)
        returning = np.sqrt(self.return_acceleration / np.maximum(np.abs(curvature), 1e-3))
        speed = np.where(offset > 0.0, np.minimum(speed, returning), speed)
        span = observation["action_span"]
        return np.stack([steer_action(curvature + more / WHEELBASE, span), speed_action(speed, span)], axis=1)


def _where_reached(away: np.ndarray, values: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Values (n, points) where the way from the car reaches a distance: (n,), between points in proportion."""
    farther = np.maximum.accumulate(away, axis=1)
    after = np.clip((farther < distance[:, None]).sum(axis=1), 1, away.shape[1] - 1)
    each = np.arange(len(away))
    low, high = farther[each, after - 1], farther[each, after]
    share = np.clip((distance - low) / np.maximum(high - low, 1e-6), 0.0, 1.0)
    return values[each, after - 1] + share * (values[each, after] - values[each, after - 1])
