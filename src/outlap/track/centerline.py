"""The centreline: a closed cubic spline measured in metres along it.

Frenet coordinates: `s` [m] along the line from the start line, `d` [m] to its left. The simulator's kernels work on a
float32 table of the same curve (`Centerline.table`).
"""

# SciPy has no type stubs:
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.spatial import KDTree

from outlap.errors import OutlapError

TABLE = np.dtype(
    [(name, np.float32) for name in ("x", "y", "tangent_x", "tangent_y", "curvature", "width_right", "width_left")],
    align=True,
)
"""A row of `Centerline.table`: position [m], unit tangent, curvature [1/m] and free widths [m]."""

MIN_POINTS = 4
LONGEST = 1e5  # [m] of a lap, and of a coordinate

# A point nearer to its predecessor than this part of the median spacing is the same point twice.
_SAME_POINT = 1e-3
# Arc length between the samples that a search for the nearest point starts from [m].
_SEARCH_SPACING = 0.02
# Pieces that a knot interval is cut into where arc length is integrated.
_PIECES = 8
# No car turns this tightly [m]: where the line does, its points zigzag.
_TIGHTEST_RADIUS = 0.2
# Widths [m] of the smoothing that is then tried, narrowest first.
_SMOOTHING = tuple(0.05 * 1.25**i for i in range(12))


@dataclass(frozen=True, eq=False)
class Centerline:
    """A closed line through given points, with the free width on each side.

    Build it with `from_points`. The curve is a periodic cubic spline through the points; every `s`
    is true arc length along it [m], periodic in `length`. Points traced on the pixels of a map zigzag,
    and a curve through them would point anywhere: where it would turn more tightly than 0.2 m, it is
    led through smoothed points instead, smoothed just as much as keeps it within that radius.
    """

    s: np.ndarray  # (n,) [m] arc length of each point; s[0] = 0
    points: np.ndarray  # (n, 2) [m]
    width_right: np.ndarray  # (n,) [m]
    width_left: np.ndarray  # (n,) [m]
    length: float  # [m]
    _curve: CubicSpline = field(repr=False)  # chord length → (x, y)
    _chord: CubicHermiteSpline = field(repr=False)  # arc length → chord length

    @classmethod
    def from_points(cls, points: ArrayLike, width_right: ArrayLike, width_left: ArrayLike) -> Centerline:
        """Fit the closed curve through `points` (n, 2) [m], in driving order.

        A last point that repeats the first is dropped, and so is any that repeats its predecessor.
        `width_right`, `width_left`: (n,) or scalar [m]. Raises OutlapError for fewer than four
        distinct points, for NaN or infinite values, for negative widths and for more than 100 km.
        """
        points = np.array(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise OutlapError(f"centreline: points have shape {points.shape}; it must be (n, 2)")
        _require_finite(points[:, 0], "x_m")
        _require_finite(points[:, 1], "y_m")
        right = _widths(width_right, len(points), "w_tr_right_m")
        left = _widths(width_left, len(points), "w_tr_left_m")

        keep = _distinct(points)
        points, right, left = points[keep], right[keep], left[keep]
        if len(points) < MIN_POINTS:
            raise OutlapError(
                f"centreline: has {len(points)} distinct points; a closed line needs at least {MIN_POINTS}"
            )
        around = float(np.hypot(*(points - np.roll(points, 1, axis=0)).T).sum())
        if around > LONGEST or np.abs(points).max() > LONGEST:
            raise OutlapError(
                f"centreline: is {around:g} m long, and up to {np.abs(points).max():g} m from the origin; must be at "
                f"most {LONGEST:g} m: are its units metres?"
            )
        curve, chord, s, length = _fit_drivable(points)
        for array in (s, points, right, left):
            array.setflags(write=False)
        return cls(s, points, right, left, length, curve, chord)

    def position(self, s: ArrayLike) -> np.ndarray:
        """Points on the line: `s` (...) [m] → (..., 2) [m]."""
        return self._curve(self._chord_at(s))

    def heading(self, s: ArrayLike) -> np.ndarray:
        """Direction of travel: `s` (...) [m] → (...) [rad] in (-pi, pi]."""
        tangent = self._tangent(s)
        heading = np.arctan2(tangent[..., 1], tangent[..., 0])
        return np.where(heading > -np.pi, heading, np.pi)  # arctan2 of -0 and -1 is -pi

    def curvature(self, s: ArrayLike) -> np.ndarray:
        """Signed curvature, positive where the line turns left: `s` (...) [m] → (...) [1/m]."""
        chord = self._chord_at(s)
        velocity, bend = self._curve(chord, 1), self._curve(chord, 2)
        return _cross(velocity, bend) / np.hypot(velocity[..., 0], velocity[..., 1]) ** 3

    def widths(self, s: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Free width right and left of the line, linear between points: `s` (...) → two (...) [m]."""
        s = np.asarray(s, dtype=np.float64)
        right = np.interp(s, self.s, self.width_right, period=self.length)
        return right, np.interp(s, self.s, self.width_left, period=self.length)

    def to_cartesian(self, s: ArrayLike, d: ArrayLike) -> np.ndarray:
        """The point `d` (...) [m] left of the line at `s` (...) [m], as (..., 2) [m]."""
        s, d = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(d, np.float64))
        tangent = self._tangent(s)
        normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
        return self.position(s) + d[..., None] * normal

    def to_frenet(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """The nearest point of the whole line to each (x, y) [m]: s in [0, length) and d, (...) [m].

        A nearest sample brackets the foot of the perpendicular; Newton's method, bisecting where a
        step leaves the bracket, finds it.
        """
        target = np.stack(np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64)), axis=-1)
        shape = target.shape[:-1]
        target = target.reshape(-1, 2)
        tree, samples = self._search_tree
        spacing = self.length / len(samples)
        start = samples[cast("NDArray[np.intp]", tree.query(target)[1])]
        low, high = start - spacing, start + spacing
        s = start.copy()
        active = np.arange(len(s))
        for _ in range(60):
            chord = self._chord_at(s[active])
            away = self._curve(chord) - target[active]
            velocity = self._curve(chord, 1)
            bend = self._curve(chord, 2)
            speed = np.hypot(velocity[:, 0], velocity[:, 1])
            tangent = velocity / speed[:, None]
            slope = np.sum(away * tangent, axis=1)  # d/ds of half the squared distance
            curvature = _cross(velocity, bend) / speed**3
            second = 1.0 + curvature * _cross(tangent, away)
            ahead = slope < 0.0  # the foot lies further on
            low[active[ahead]] = s[active[ahead]]
            high[active[~ahead]] = s[active[~ahead]]
            with np.errstate(divide="ignore", invalid="ignore"):
                step = s[active] - slope / second
            inside = (second > 0.0) & (step >= low[active]) & (step <= high[active])
            moved = np.where(inside, step, 0.5 * (low[active] + high[active]))
            change = np.abs(moved - s[active])
            s[active] = moved
            active = active[change > 1e-10]
            if active.size == 0:
                break
        d = _cross(self._tangent(s), target - self.position(s))
        s %= self.length
        s[s >= self.length] = 0.0  # the remainder of a tiny negative number rounds to the length
        return s.reshape(shape), d.reshape(shape)

    def table(self, spacing: float = 0.1) -> np.ndarray:
        """Return the line sampled uniformly in s, about `spacing` [m] apart: (m,) records of TABLE.

        Row i is at s = i·h with h = length / m.
        """
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise OutlapError(f"centreline table: spacing is {spacing}; it must be a positive number of metres")
        rows = max(MIN_POINTS, math.ceil(self.length / spacing - 1e-9))
        s = np.arange(rows) * (self.length / rows)
        table = np.empty(rows, TABLE)
        table["x"], table["y"] = self.position(s).T
        table["tangent_x"], table["tangent_y"] = self._tangent(s).T
        table["curvature"] = self.curvature(s)
        table["width_right"], table["width_left"] = self.widths(s)
        return table

    def _chord_at(self, s: ArrayLike) -> np.ndarray:
        return self._chord(np.mod(np.asarray(s, dtype=np.float64), self.length))

    def _tangent(self, s: ArrayLike) -> np.ndarray:
        velocity = self._curve(self._chord_at(s), 1)
        return velocity / np.hypot(velocity[..., 0], velocity[..., 1])[..., None]

    @cached_property
    def _search_tree(self) -> tuple[KDTree, np.ndarray]:
        count = max(64, math.ceil(self.length / _SEARCH_SPACING))
        samples = np.arange(count) * (self.length / count)
        return KDTree(self.position(samples)), samples


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The z component of a × b for (..., 2) vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _require_finite(values: np.ndarray, name: str) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise OutlapError(f"centreline: {name} of point {bad[0] + 1} is {values[bad[0]]}; it must be finite")


def _widths(values: ArrayLike, count: int, name: str) -> np.ndarray:
    widths = np.array(values, dtype=np.float64)
    if widths.ndim == 0:
        widths = np.full(count, widths)
    if widths.shape != (count,):
        raise OutlapError(f"centreline: {name} has shape {widths.shape}; it must be ({count},), one a point")
    _require_finite(widths, name)
    bad = np.flatnonzero(widths < 0.0)
    if bad.size:
        raise OutlapError(
            f"centreline: {name} of point {bad[0] + 1} is {widths[bad[0]]}; it must be zero or more metres"
        )
    return widths


def _distinct(points: np.ndarray) -> np.ndarray:
    """Which points (n, 2) to keep: not the ones that repeat the point before, nor a closing one."""
    if len(points) < 2:
        return np.ones(len(points), dtype=bool)
    gap = np.hypot(*(points - np.roll(points, 1, axis=0)).T)  # from the point before; gap[0] closes
    same = _SAME_POINT * np.median(gap[gap > 0.0]) if np.any(gap > 0.0) else 0.0
    keep = gap > same
    if not keep[0]:  # the start line is the first point: of a closing pair the last one goes
        keep[0] = True
        last = len(points) - 1
        while last > 0 and not keep[last]:
            last -= 1
        if last > 0:
            keep[last] = False
    return keep


def _fit_drivable(points: np.ndarray) -> tuple[CubicSpline, CubicHermiteSpline, np.ndarray, float]:
    """`_fit` through points (n, 2), or through smoothed ones where no car could follow them."""
    fitted = _fit(points)
    if _sharpest(fitted) * _TIGHTEST_RADIUS <= 1.0:
        return fitted
    closed = np.vstack([points, points[:1]])
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    length = float(chord[-1])
    count = max(256, math.ceil(length / 0.01))
    spacing = length / count
    dense = np.column_stack([np.interp(np.arange(count) * spacing, chord, closed[:, axis]) for axis in (0, 1)])
    at = np.append(np.arange(count), count) * spacing
    for width in _SMOOTHING:
        smooth = cast("np.ndarray", ndimage.gaussian_filter1d(dense, width / spacing, axis=0, mode="wrap"))
        smooth = np.vstack([smooth, smooth[:1]])
        candidate = _fit(np.column_stack([np.interp(chord[:-1], at, smooth[:, axis]) for axis in (0, 1)]))
        if _sharpest(candidate) * _TIGHTEST_RADIUS <= 1.0:
            return candidate
    return fitted  # a toy circuit that is truly this tight


def _sharpest(fitted: tuple[CubicSpline, CubicHermiteSpline, np.ndarray, float]) -> float:
    """The greatest curvature [1/m] of a fitted curve."""
    curve, chord = fitted[:2]
    velocity, bend = curve(chord.c[3], 1), curve(chord.c[3], 2)  # at the ends of every piece
    return float(np.max(np.abs(_cross(velocity, bend)) / np.hypot(velocity[:, 0], velocity[:, 1]) ** 3))


def _fit(points: np.ndarray) -> tuple[CubicSpline, CubicHermiteSpline, np.ndarray, float]:
    """The closed spline through points (n, 2), its arc length → chord map, the points' s, its length."""
    closed = np.vstack([points, points[:1]])
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    curve = CubicSpline(chord, closed, bc_type="periodic")

    part = np.arange(_PIECES) / _PIECES
    dense = np.append((chord[:-1, None] + np.diff(chord)[:, None] * part).ravel(), chord[-1])
    nodes, weights = np.polynomial.legendre.leggauss(5)
    half = 0.5 * np.diff(dense)
    inner = dense[:-1, None] + half[:, None] * (nodes + 1.0)
    velocity = curve(inner, 1)
    s = np.concatenate([[0.0], np.cumsum(half * (np.hypot(velocity[..., 0], velocity[..., 1]) @ weights))])
    speed = np.hypot(*curve(dense, 1).T)
    if np.any(speed < 1e-9) or np.any(np.diff(s) <= 0.0):
        where = points[np.argmin(speed[:-1:_PIECES])]
        raise OutlapError(
            f"centreline: stands still near ({where[0]:.3f}, {where[1]:.3f}); points must follow one another "
            "along the track"
        )
    return curve, CubicHermiteSpline(s, dense, 1.0 / speed), s[:-1:_PIECES].copy(), float(s[-1])
