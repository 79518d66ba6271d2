"""The centreline: a closed cubic spline measured in metres along it, in Python and in kernels.

Frenet coordinates: `s` [m] along the line from the start line, `d` [m] to its left.
`Centerline` works on arrays in float64. The kernels at the end work on one point and on a float32
table of the same curve, from a starting guess, and hold no NumPy calls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.spatial import KDTree

from outlap.errors import OutlapError

X, Y, TANGENT_X, TANGENT_Y, CURVATURE, WIDTH_RIGHT, WIDTH_LEFT = range(7)
TABLE_COLUMNS = 7

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
        start = samples[tree.query(target)[1]]
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
        """The line sampled uniformly in s: (m, TABLE_COLUMNS) float32, about `spacing` [m] apart.

        Row i is at s = i·h with h = length / m. Columns: X, Y, TANGENT_X, TANGENT_Y, CURVATURE,
        WIDTH_RIGHT, WIDTH_LEFT.
        """
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise OutlapError(f"centreline table: spacing is {spacing}; it must be a positive number of metres")
        rows = max(MIN_POINTS, math.ceil(self.length / spacing - 1e-9))
        s = np.arange(rows) * (self.length / rows)
        table = np.empty((rows, TABLE_COLUMNS), dtype=np.float32)
        table[:, X : Y + 1] = self.position(s)
        table[:, TANGENT_X : TANGENT_Y + 1] = self._tangent(s)
        table[:, CURVATURE] = self.curvature(s)
        table[:, WIDTH_RIGHT], table[:, WIDTH_LEFT] = self.widths(s)
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
    count = max(256, math.ceil(chord[-1] / 0.01))
    spacing = chord[-1] / count
    dense = np.column_stack([np.interp(np.arange(count) * spacing, chord, closed[:, axis]) for axis in (0, 1)])
    at = np.append(np.arange(count), count) * spacing
    for width in _SMOOTHING:
        smooth = ndimage.gaussian_filter1d(dense, width / spacing, axis=0, mode="wrap")
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


# Kernels. `table` may hold many lines one after another: `row0` is the first row of this one, `rows`
# their number and `h` the spacing [m]. Between rows the curve is the cubic Hermite segment of the two
# positions and tangents.

_MAX_STEP = 2.0  # [m] a Newton step is cut to this
_MAX_ITERATIONS = 12
_TOLERANCE = 1e-3  # [m] a step this small is the last: Newton's next would be its square


@njit(cache=True, error_model="numpy", inline="always")
def _wrap(s, length):
    """`s` brought into [0, length); 0 for what is not finite."""
    if 0.0 <= s < length:  # nearly always, and a division cheaper
        return s
    s -= length * math.floor(s / length)
    return s if 0.0 <= s < length else 0.0


@njit(cache=True, error_model="numpy")
def frenet_project(table, row0, rows, h, x, y, s_guess):
    """The foot of the perpendicular from (x, y) [m] on the line near `s_guess` [m].

    Returns (s in [0, length), d, heading of the tangent there). Newton's method on
    (r(s) − p)·r'(s) = 0; outside the line's evolute it walks downhill instead. Finite for finite
    input; never reads outside the table.
    """
    length = rows * h
    inverse = 1.0 / h
    # A first step from the row before the guess, along its tangent and circle, mostly ends within a
    # centimetre and costs half of one on the curve.
    i = min(int(_wrap(float(s_guess), length) * inverse), rows - 1)
    a = row0 + i
    away_x, away_y = x - table[a, X], y - table[a, Y]
    ax, ay = float(table[a, TANGENT_X]), float(table[a, TANGENT_Y])
    step = (away_x * ax + away_y * ay) / max(1.0 - table[a, CURVATURE] * (ax * away_y - ay * away_x), 0.2)
    s = _wrap(i * h + (step if -_MAX_STEP < step < _MAX_STEP else 0.0), length)
    velocity_x, velocity_y = 1.0, 0.0
    bend_x = bend_y = 0.0
    for _ in range(_MAX_ITERATIONS):
        scaled = s * inverse
        i = min(int(scaled), rows - 1)
        t = scaled - i
        a = row0 + i
        b = row0 + (i + 1 if i + 1 < rows else 0)
        chord_x = float(table[b, X]) - float(table[a, X])
        chord_y = float(table[b, Y]) - float(table[a, Y])
        ax, ay = h * table[a, TANGENT_X], h * table[a, TANGENT_Y]
        bx, by = h * table[b, TANGENT_X], h * table[b, TANGENT_Y]
        # r(t) = r_a + t·(a + t·(c2 + t·c3)), all derivatives with respect to t
        c3x, c3y = ax + bx - 2.0 * chord_x, ay + by - 2.0 * chord_y
        c2x, c2y = chord_x - ax - c3x, chord_y - ay - c3y
        away_x = table[a, X] - x + t * (ax + t * (c2x + t * c3x))
        away_y = table[a, Y] - y + t * (ay + t * (c2y + t * c3y))
        velocity_x = ax + t * (2.0 * c2x + 3.0 * t * c3x)
        velocity_y = ay + t * (2.0 * c2y + 3.0 * t * c3y)
        bend_x = 2.0 * c2x + 6.0 * t * c3x
        bend_y = 2.0 * c2y + 6.0 * t * c3y
        squared = velocity_x * velocity_x + velocity_y * velocity_y
        slope = away_x * velocity_x + away_y * velocity_y
        second = squared + away_x * bend_x + away_y * bend_y
        floor = 0.05 * squared  # where distance is not convex, take a bounded step downhill
        step = -h * slope / (second if second > floor else max(-second, floor))
        if not (step >= -_MAX_STEP):
            step = -_MAX_STEP
        elif step > _MAX_STEP:
            step = _MAX_STEP
        s = _wrap(s + step, length)
        if -_TOLERANCE < step < _TOLERANCE:
            break
    # Carry the last evaluation over the last step.
    t = step * inverse
    if -1.0 < t < 1.0:
        away_x += t * (velocity_x + 0.5 * t * bend_x)
        away_y += t * (velocity_y + 0.5 * t * bend_y)
        velocity_x += t * bend_x
        velocity_y += t * bend_y
    norm = 1.0 / math.sqrt(velocity_x * velocity_x + velocity_y * velocity_y)
    d = (velocity_y * away_x - velocity_x * away_y) * norm
    return s, d, math.atan2(velocity_y, velocity_x)


@njit(cache=True, error_model="numpy")
def frenet_point(table, row0, rows, h, s, d):
    """The point `d` [m] left of the line at `s` [m]: (x, y, heading of the tangent)."""
    s = _wrap(float(s), rows * h)
    scaled = s / h
    i = min(int(scaled), rows - 1)
    t = scaled - i
    a = row0 + i
    b = row0 + (i + 1 if i + 1 < rows else 0)
    chord_x = float(table[b, X]) - float(table[a, X])
    chord_y = float(table[b, Y]) - float(table[a, Y])
    ax, ay = h * table[a, TANGENT_X], h * table[a, TANGENT_Y]
    bx, by = h * table[b, TANGENT_X], h * table[b, TANGENT_Y]
    c3x, c3y = ax + bx - 2.0 * chord_x, ay + by - 2.0 * chord_y
    c2x, c2y = chord_x - ax - c3x, chord_y - ay - c3y
    velocity_x = ax + t * (2.0 * c2x + 3.0 * t * c3x)
    velocity_y = ay + t * (2.0 * c2y + 3.0 * t * c3y)
    norm = d / math.sqrt(velocity_x * velocity_x + velocity_y * velocity_y)
    x = table[a, X] + t * (ax + t * (c2x + t * c3x)) - norm * velocity_y
    y = table[a, Y] + t * (ay + t * (c2y + t * c3y)) + norm * velocity_x
    return x, y, math.atan2(velocity_y, velocity_x)
