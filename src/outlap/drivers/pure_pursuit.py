"""Pure pursuit of the racing line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from outlap.drivers.vehicle_actions import speed_action, steer_action


@dataclass(frozen=True)
class PurePursuit:
    """Drives the arc through a point of the racing line ahead, at the line's speed (Coulter, 1992).

    The point is farther ahead the faster the car is. The line is the track's raceline, or else its centreline.
    """

    lookahead: float = 0.6  # [m] at a standstill
    lookahead_time: float = 0.2  # [s] more for every m/s
    speed_share: float = 1.0  # of the line's speed
    preview_time: float = 0.1  # [s] ahead from where the speed is taken: what the car takes to follow a command
    name: str = "pure-pursuit"
    observation_terms: tuple[str, ...] = ("line_ahead", "vel", "action_span")
    scale_observations: bool = False

    def begin(self, cars: np.ndarray) -> None:
        """See `Driver.begin`; it remembers nothing."""

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        line = observation["line_ahead"].reshape(len(observation["vel"]), -1, 3)
        x, y, speeds = line[..., 0], line[..., 1], line[..., 2]
        forward = np.maximum(observation["vel"][:, 0], 0.0)
        away = np.hypot(x, y)
        target_x, target_y = (
            _where_reached(away, values, self.lookahead + self.lookahead_time * forward) for values in (x, y)
        )
        curvature = 2.0 * target_y / np.maximum(target_x**2 + target_y**2, 1e-6)
        speed = self.speed_share * _where_reached(away, speeds, self.preview_time * forward)
        span = observation["action_span"]
        return np.stack([steer_action(curvature, span), speed_action(speed, span)], axis=1)


def _where_reached(away: np.ndarray, values: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Values (n, points) where the way from the car reaches a distance: (n,), between points in proportion."""
    farther = np.maximum.accumulate(away, axis=1)
    after = np.clip((farther < distance[:, None]).sum(axis=1), 1, away.shape[1] - 1)
    each = np.arange(len(away))
    low, high = farther[each, after - 1], farther[each, after]
    share = np.clip((distance - low) / np.maximum(high - low, 1e-6), 0.0, 1.0)
    return values[each, after - 1] + share * (values[each, after] - values[each, after - 1])
