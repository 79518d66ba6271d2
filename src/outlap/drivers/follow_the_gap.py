"""Follow the gap: driving by LiDAR alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from outlap.drivers.driver import Driver
from outlap.drivers.vehicle_actions import speed_action, steer_action
from outlap.errors import OutlapError

LEAST_BEAMS = 9


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
        arc = np.tan(steer * span[:, 0]) / 0.33
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
