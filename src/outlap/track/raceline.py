"""The racing line: where to drive and how fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Raceline:
    """A closed line sampled along its own arc length; one (n,) array a column of the F1TENTH file."""

    s: np.ndarray  # (n,) [m] along the racing line
    x: np.ndarray  # (n,) [m]
    y: np.ndarray  # (n,) [m]
    heading: np.ndarray  # (n,) [rad], as in the file: not wrapped
    curvature: np.ndarray  # (n,) [1/m]
    speed: np.ndarray  # (n,) [m/s]
    acceleration: np.ndarray  # (n,) [m/s²] longitudinal

    @property
    def lap_time(self) -> float:
        """At these speeds, with constant acceleration from point to point [s]."""
        steps = np.hypot(np.roll(self.x, -1) - self.x, np.roll(self.y, -1) - self.y)
        return float(np.sum(2.0 * steps / (self.speed + np.roll(self.speed, -1))))
