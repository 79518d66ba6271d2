"""A closed path: points, headings and curvatures at equal distances along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from outlap.track.centerline import Centerline


@dataclass(frozen=True, eq=False)
class ClosedPath:
    """A closed line sampled at equal distances along it."""

    points: np.ndarray  # (n, 2) [m]
    heading: np.ndarray  # (n,) [rad], continuous: not wrapped
    curvature: np.ndarray  # (n,) [1/m], left positive
    length: float  # [m]

    @property
    def spacing(self) -> float:
        """Between neighbouring points [m]."""
        return self.length / len(self.points)

    @property
    def s(self) -> np.ndarray:
        """(n,) [m] along the path."""
        return np.arange(len(self.points)) * self.spacing

    @property
    def normal(self) -> np.ndarray:
        """To the left: (n, 2)."""
        return np.column_stack([-np.sin(self.heading), np.cos(self.heading)])

    def shifted(self, offset: np.ndarray) -> np.ndarray:
        """The points moved to the left by offsets (n,) [m]: (n, 2)."""
        return self.points + offset[:, None] * self.normal

    def resampled(self, spacing: float) -> ClosedPath:
        """The same path, sampled about `spacing` [m] apart: curvature is linear in between, and so smooths nothing."""
        steps = np.full(len(self.points), self.spacing)
        return path_from(self.points, self.heading, self.curvature, steps, spacing)


def path_along(line: Centerline, spacing: float) -> ClosedPath:
    """A spline sampled at equal distances of about `spacing` [m]."""
    count = _count(line.length, spacing)
    s = np.arange(count) * (line.length / count)
    return ClosedPath(line.position(s), np.unwrap(line.heading(s)), line.curvature(s), line.length)


def path_through(points: np.ndarray, spacing: float) -> ClosedPath:
    """The periodic cubic spline through points (m, 2) [m], sampled about `spacing` [m] apart, from the first on."""
    return path_along(Centerline.from_points(points, 0.0, 0.0), spacing)


def path_from(
    points: np.ndarray, heading: np.ndarray, curvature: np.ndarray, steps: np.ndarray, spacing: float
) -> ClosedPath:
    """A path whose headings and curvatures are known, sampled at equal distances.

    Args:
        points: (n, 2) [m].
        heading: (n,) [rad], not wrapped.
        curvature: (n,) [1/m].
        steps: (n,) [m] along the path from each point to the next, from the last to the first.
        spacing: of the samples, about [m].
    """
    s = np.concatenate([[0.0], np.cumsum(steps)])
    turn = 2.0 * math.pi * round((heading[-1] - heading[0]) / (2.0 * math.pi))
    heading = np.append(heading, heading[0] + turn)
    tangent = np.column_stack([np.cos(heading), np.sin(heading)])
    curve = CubicHermiteSpline(s, np.vstack([points, points[:1]]), tangent)
    count = _count(s[-1], spacing)
    at = np.arange(count) * (s[-1] / count)
    return ClosedPath(
        curve(at), np.interp(at, s, heading), np.interp(at, s, np.append(curvature, curvature[0])), float(s[-1])
    )


def _count(length: float, spacing: float) -> int:
    return max(16, math.ceil(length / spacing - 1e-9))
