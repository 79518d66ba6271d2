"""Planning a line around a track by the name of the method, and checking it against the map."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from outlap.errors import OutlapError
from outlap.planning.corridor import wall_margin
from outlap.planning.friction import FrictionMap
from outlap.planning.limits import CarLimits
from outlap.planning.path import ClosedPath, path_along
from outlap.planning.speed_profile import lap_time, speed_profile
from outlap.track.raceline import Raceline
from outlap.track.track import Track

Method = Literal["centerline", "min-curvature", "min-time"]
METHODS: tuple[Method, ...] = get_args(Method)

log = logging.getLogger(__name__)

DEFAULT_MARGIN = 0.15  # [m] to the walls on either side of the car
SPACING = 0.05  # [m] of the points of a planned line
TOLERANCE = 0.01  # [m] of the margin
ROUNDS = 4  # at most, in which a line is planned anew with what it lacks in margin


@dataclass(frozen=True, eq=False)
class PlannedLine:
    """A line around a track for one car, and its speeds."""

    path: ClosedPath
    speed: np.ndarray  # (n,) [m/s]
    method: Method
    limits: CarLimits
    lap_time: float  # [s]
    min_margin: float  # [m] between the car's body and the nearest wall of the map, where it is least
    solve_time: float  # [s] that planning took

    @property
    def raceline(self) -> Raceline:
        """As the F1TENTH file has it: headings in [0, 2 pi); an acceleration holds up to the next point."""
        path, square = self.path, self.speed**2
        acceleration = (np.roll(square, -1) - square) / (2.0 * path.spacing)
        x, y = path.points.T
        return Raceline(path.s, x, y, np.mod(path.heading, 2.0 * math.pi), path.curvature, self.speed, acceleration)


def plan_line(
    track: Track,
    limits: CarLimits,
    method: Method = "min-time",
    margin: float = DEFAULT_MARGIN,
    friction: FrictionMap | None = None,
) -> PlannedLine:
    """Return the line that a method finds, with the fastest speeds on it.

    Args:
        track: to drive on.
        limits: of the car.
        method: centerline, min-curvature or min-time.
        margin: to keep from the walls, on either side of the car [m].
        friction: that differs from place to place; none: the car's everywhere.

    Raises OutlapError, with the arc length and the constraint, for a track that is narrower than the car and its
    margins, a bend that the car cannot steer, or a solver that comes to no line.
    """
    if not (math.isfinite(margin) and margin >= 0.0):
        raise OutlapError(f"margin is {margin}; it must be zero or more metres")
    if method not in METHODS:
        raise OutlapError(f"method is {method!r}; it must be one of {', '.join(METHODS)}")
    begun = time.perf_counter()
    if method == "centerline":
        path, speed, seconds = _timed(track, path_along(track.centerline, SPACING), limits, friction)
    else:
        least = _least_curvature(track, limits, margin)
        path, speed, seconds = _timed(track, least.resampled(SPACING), limits, friction)
        if method == "min-time":
            fastest = _least_time(track, limits, margin, least, friction)
            timed = _timed(track, fastest.resampled(SPACING), limits, friction)
            # Both keep to the same limits, if the car can steer both: the slower one is not the minimum.
            if timed[2] <= seconds or _beyond_lock(path, limits):
                path, speed, seconds = timed
    margins = wall_margin(track, path, limits)
    planned = PlannedLine(path, speed, method, limits, seconds, float(margins.min()), time.perf_counter() - begun)
    _require_drivable(track, planned, margins)
    if method != "centerline" and planned.min_margin < margin - 2.0 * TOLERANCE:
        log.warning("%s: the line keeps %.3f m from the walls, not %.3f m", track.name, planned.min_margin, margin)
    return planned


def _least_curvature(track: Track, limits: CarLimits, margin: float) -> ClosedPath:
    """The line of least curvature.

    Between its points a line may come a little nearer to the walls: what it lacks is asked for anew, if there is room.
    """
    from outlap.planning.min_curvature import min_curvature  # CasADi: not before it is needed

    log.info("%s: the line of least curvature", track.name)
    path, asked = min_curvature(track, limits, margin), margin
    for _ in range(ROUNDS):
        short = margin - _nearest(track, path, limits)
        if short < TOLERANCE:
            break
        try:
            path = min_curvature(track, limits, asked + short)
        except OutlapError:
            break
        asked += short
    return path


def _least_time(
    track: Track, limits: CarLimits, margin: float, reference: ClosedPath, friction: FrictionMap | None
) -> ClosedPath:
    """The line of least time, found in rounds: each about the line before, with what that lacked in margin."""
    from outlap.planning.min_time import MinTimeProblem, spacing_for

    path, asked = reference, margin
    for number in range(1, ROUNDS + 1):
        log.info("%s: the line of least time, round %d", track.name, number)
        try:
            problem = MinTimeProblem(track, path.resampled(spacing_for(path)), limits, asked, friction)
            path = problem.solve(limits)
        except OutlapError:
            if number == 1:
                raise
            break  # what it lacked is not there
        short = margin - _nearest(track, path, limits)
        if number > 1 and short < TOLERANCE:
            break
        asked += max(short, 0.0)
    return path


def _nearest(track: Track, path: ClosedPath, limits: CarLimits) -> float:
    """Return how near a car on a line comes to the walls [m]."""
    return float(wall_margin(track, path.resampled(2.0 * SPACING), limits).min())


def _timed(
    track: Track, path: ClosedPath, limits: CarLimits, friction: FrictionMap | None
) -> tuple[ClosedPath, np.ndarray, float]:
    """A line, its fastest speeds and its lap time."""
    mu = None if friction is None else friction.at(*track.centerline.to_frenet(*path.points.T))
    speed = speed_profile(path.curvature, path.spacing, limits, mu)
    return path, speed, lap_time(speed, path.spacing)


def _beyond_lock(path: ClosedPath, limits: CarLimits) -> bool:
    """Whether a line turns more tightly than a car at full lock, by more than what sampling makes of a curvature."""
    return float(np.abs(path.curvature).max()) > 1.02 * limits.max_curvature


def _require_drivable(track: Track, planned: PlannedLine, margins: np.ndarray) -> None:
    path, limits = planned.path, planned.limits
    worst = int(margins.argmin())
    if margins[worst] <= 0.0:
        s = float(track.centerline.to_frenet(*path.points[worst])[0])
        raise OutlapError(
            f"track {track.name}: on the {planned.method} line the car touches a wall at s = {s:.1f} m; take a larger "
            "margin, or another method"
        )
    if planned.method != "centerline" and _beyond_lock(path, limits):
        sharpest = int(np.abs(path.curvature).argmax())
        s = float(track.centerline.to_frenet(*path.points[sharpest])[0])
        raise OutlapError(
            f"track {track.name}: at s = {s:.1f} m the {planned.method} line has a curvature of "
            f"{abs(path.curvature[sharpest]):.2f} 1/m, and at full lock the car drives {limits.max_curvature:.2f}; "
            "take min-time, which keeps to that, a smaller margin, or a car that steers farther"
        )
