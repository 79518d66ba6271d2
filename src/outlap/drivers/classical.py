"""The drivers that need no training: along the centreline, along the racing line, and by LiDAR alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from outlap.drivers.driver import Driver
from outlap.errors import OutlapError

WHEELBASE = 0.33  # [m] of a 1:10 car
STEER_STOP = 0.4189  # [rad]
LEAST_BEAMS = 9  # of a scan that shows gaps


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


@dataclass(frozen=True)
class FollowTheGap(Driver):
    """Heads for the middle of the deepest gap that the car fits through (Sezer & Gokasan, 2012).

    Every return blocks the directions in which the car would touch it; what is left free in each direction is that
    far free. Speed is what the brakes can take off before the end of the free way, and grip through the arc.
    """

    field_of_view: float = 4.7  # [rad] of the scan
    half_width: float = 0.25  # [m] of the car, with room to spare
    horizon: float = 10.0  # [m] beyond which all is free
    gap_share: float = 0.7  # of the farthest free way that still belongs to its gap
    lookahead: float = 1.5  # [m] of the arc towards the gap
    braking: float = 4.0  # [m/s²] counted on
    cornering: float = 5.0  # [m/s²] counted on
    name: str = "follow-the-gap"
    observation_terms: tuple[str, ...] = ("scan", "action_span")

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        angles, free = self._free_ways(observation["scan"])
        each, deepest = np.arange(len(free)), free.argmax(axis=1)
        inside = free >= self.gap_share * free[each, deepest, None]
        number = np.arange(len(angles))
        right = np.where(~inside & (number < deepest[:, None]), number, -1).max(axis=1) + 1
        left = np.where(~inside & (number > deepest[:, None]), number, len(angles)).min(axis=1) - 1
        heading = 0.5 * (angles[right] + angles[left])
        curvature = 2.0 * np.sin(heading) / self.lookahead
        span = observation["action_span"]
        steer = steer_action(curvature, span)
        arc = np.tan(steer * span[:, 0]) / WHEELBASE
        way = np.minimum(free[each, np.abs(angles).argmin()], free[each, deepest])
        speed = np.minimum(np.sqrt(2.0 * self.braking * way), np.sqrt(self.cornering / np.maximum(np.abs(arc), 1e-3)))
        return np.stack([steer, speed_action(speed, span)], axis=1)

    def _free_ways(self, scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions [rad] (m,) in the front half, and how far the car can go in each before it touches: (n, m)."""
        if scan.shape[1] < LEAST_BEAMS:
            raise OutlapError(f"driver {self.name}: has {scan.shape[1]} beams; must have {LEAST_BEAMS} or more")
        angles = np.linspace(-0.5 * self.field_of_view, 0.5 * self.field_of_view, scan.shape[1])
        step = max(1, round(math.radians(2.0) / (angles[1] - angles[0])))
        ahead = np.flatnonzero(np.abs(angles) <= 0.5 * math.pi)[::step]
        ranges, angles = np.minimum(scan[:, ahead], self.horizon), angles[ahead]
        blocked = np.arcsin(np.minimum(1.0, self.half_width / np.maximum(ranges, 1e-3)))  # to either side of a return
        touches = np.abs(angles[:, None] - angles) <= blocked[:, None, :]  # (n, direction, return)
        return angles, np.where(touches, ranges[:, None, :], self.horizon).min(axis=2)


def steer_action(curvature: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Steering that drives an arc slowly: (n,) in [-1, 1] from its curvature [1/m], left positive."""
    return np.clip(np.arctan(WHEELBASE * curvature) / span[:, 0], -1.0, 1.0)


def speed_action(speed: np.ndarray, span: np.ndarray) -> np.ndarray:
    """The action that commands a speed, or the nearest that can be: (n,) in [-1, 1] from [m/s]."""
    slowest, fastest = span[:, 1], span[:, 2]
    return np.clip(2.0 * (speed - slowest) / np.maximum(fastest - slowest, 1e-6) - 1.0, -1.0, 1.0)
