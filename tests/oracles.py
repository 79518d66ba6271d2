"""Slow truth: geometry, actuators and hashing from their mathematics, in float64 and plain Python.

Nothing here knows how outlap does it: no distance field, no tiles, no separating axes, no Numba. A grid is
`occupancy` (height, width) bool with row 0 at the bottom, `resolution` [m] and `origin` (x, y, yaw), as in
`Track`; a rectangle is its pose (x, y, yaw) [m, m, rad] and its full length and width [m].
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from outlap.track.track import Track

Polygon = list[tuple[float, float]]  # corners, anticlockwise


# Rays


def cast_rays_at_walls(occupancy, resolution, origin, x, y, angles, max_range, grow=0.0) -> np.ndarray:
    """Distance along each ray to the first wall square, by testing every square: (rays,) [m].

    Args:
        angles: (rays,) directions in the map frame [rad].
        max_range: [m] what a ray reads that meets nothing nearer.
        grow: [cells] by which every wall square is larger on each side (smaller where negative).
    """
    col, row, yaw = _in_grid(resolution, origin, x, y)
    height, width = occupancy.shape
    if not (0.0 <= col < width and 0.0 <= row < height) or occupancy[int(row), int(col)]:
        return np.zeros(len(angles))
    # A ray that starts in the open meets the shell of the walls first; outside the map all is wall.
    wall = np.pad(np.asarray(occupancy, bool), 2, constant_values=True)
    inner = np.ones_like(wall)
    for shift_row in (-1, 0, 1):
        for shift_col in (-1, 0, 1):
            inner &= np.roll(wall, (shift_row, shift_col), (0, 1))
    rows, cols = np.nonzero((wall & ~inner)[1:-1, 1:-1])
    left, low = cols - 1.0 - grow, rows - 1.0 - grow
    right, high = cols + grow, rows + grow
    near_enough = np.hypot(cols - 0.5 - col, rows - 0.5 - row) < max_range / resolution + 2.0
    left, low, right, high = (side[near_enough] for side in (left, low, right, high))

    ranges = np.full(len(angles), float(max_range))
    for k, angle in enumerate(np.asarray(angles, np.float64) - yaw):
        enter_x, leave_x = _slab(left, right, col, math.cos(angle))
        enter_y, leave_y = _slab(low, high, row, math.sin(angle))
        enter, leave = np.maximum(enter_x, enter_y), np.minimum(leave_x, leave_y)
        met = (enter <= leave) & (leave >= 0.0)
        if met.any():
            ranges[k] = min(max_range, max(0.0, float(enter[met].min())) * resolution)
    return ranges


def _in_grid(resolution, origin, x, y) -> tuple[float, float, float]:
    """A point of the map frame as (column, row), and the grid's yaw."""
    yaw = origin[2]
    dx, dy = x - origin[0], y - origin[1]
    return (
        (math.cos(yaw) * dx + math.sin(yaw) * dy) / resolution,
        (math.cos(yaw) * dy - math.sin(yaw) * dx) / resolution,
        yaw,
    )


def _slab(low: np.ndarray, high: np.ndarray, start: float, direction: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray enters and leaves each strip low <= coordinate <= high."""
    if abs(direction) < 1e-15:
        inside = (low <= start) & (start <= high)
        return np.where(inside, -np.inf, np.inf), np.where(inside, np.inf, -np.inf)
    first, second = (low - start) / direction, (high - start) / direction
    return np.minimum(first, second), np.maximum(first, second)


def cast_rays_at_rectangle(x, y, angles, rectangle) -> np.ndarray:
    """Distance along each ray to a rectangle's outline: (rays,) [m], inf where it misses, 0 from inside."""
    corners = rectangle_corners(*rectangle)
    sides = list(zip(corners, corners[1:] + corners[:1], strict=True))
    if all(_cross(b[0] - a[0], b[1] - a[1], x - a[0], y - a[1]) >= 0.0 for a, b in sides):
        return np.zeros(len(angles))
    ranges = np.full(len(angles), np.inf)
    for k, angle in enumerate(angles):
        ray_x, ray_y = math.cos(angle), math.sin(angle)
        for (ax, ay), (bx, by) in sides:
            # (x, y) + t ray = a + u (b - a)
            side_x, side_y = bx - ax, by - ay
            area = _cross(ray_x, ray_y, side_x, side_y)
            if area == 0.0:
                continue
            t = _cross(ax - x, ay - y, side_x, side_y) / area
            u = _cross(ax - x, ay - y, ray_x, ray_y) / area
            if t >= 0.0 and 0.0 <= u <= 1.0:
                ranges[k] = min(ranges[k], t)
    return ranges


def _cross(ax: float, ay: float, bx: float, by: float) -> float:
    return ax * by - ay * bx


# Contact


def rectangle_corners(x, y, yaw, length, width) -> Polygon:
    """The corners of a rectangle, anticlockwise from the rear right one."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    corners = []
    for ahead, left in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
        u, v = ahead * length, left * width
        corners.append((x + cos * u - sin * v, y + sin * u + cos * v))
    return corners


def polygon_area(polygon: Sequence[tuple[float, float]]) -> float:
    """The shoelace formula [m^2]."""
    following = [*polygon[1:], *polygon[:1]]
    return 0.5 * sum(ax * by - bx * ay for (ax, ay), (bx, by) in zip(polygon, following, strict=True))


def clip_polygon(polygon: Polygon, window: Polygon) -> Polygon:
    """What two convex polygons have in common (Sutherland and Hodgman, 1974)."""
    for (ax, ay), (bx, by) in zip(window, window[1:] + window[:1], strict=True):
        heights = [_cross(bx - ax, by - ay, px - ax, py - ay) for px, py in polygon]
        kept: Polygon = []
        for k, (px, py) in enumerate(polygon):
            qx, qy = polygon[k - 1]
            here, before = heights[k], heights[k - 1]
            if (here >= 0.0) != (before >= 0.0):
                share = before / (before - here)
                kept.append((qx + share * (px - qx), qy + share * (py - qy)))
            if here >= 0.0:
                kept.append((px, py))
        polygon = kept
        if len(polygon) < 3:
            return []
    return polygon


def overlap_area(first: Polygon, second: Polygon) -> float:
    """The area that two convex polygons share [m^2]."""
    common = clip_polygon(first, second)
    return polygon_area(common) if common else 0.0


def overlaps_wall(occupancy, resolution, origin, rectangle) -> bool:
    """Whether a rectangle shares any area with a wall square, or with what lies outside the map."""
    x, y, yaw, length, width = rectangle
    col, row, map_yaw = _in_grid(resolution, origin, x, y)
    body = rectangle_corners(col, row, yaw - map_yaw, length / resolution, width / resolution)
    rows, cols = occupancy.shape
    low_col, high_col = min(c for c, _ in body), max(c for c, _ in body)
    low_row, high_row = min(r for _, r in body), max(r for _, r in body)
    if low_col < 0.0 or low_row < 0.0 or high_col > cols or high_row > rows:
        return True
    for j in range(int(low_row), min(int(high_row) + 1, rows)):
        for i in range(int(low_col), min(int(high_col) + 1, cols)):
            square = [(i, j), (i + 1.0, j), (i + 1.0, j + 1.0), (i, j + 1.0)]
            if occupancy[j, i] and overlap_area(body, square) > 1e-12:
                return True
    return False


# Actuators


class DelayAndLag:
    """One command channel: a delay of whole steps, then a first-order lag y' = (u - y) / time_constant."""

    def __init__(self, initial: float, steps: int, time_constant: float, dt: float) -> None:
        self._given = [initial] * (steps + 1)
        self._steps = steps
        self._output = initial
        # Exact solution of the lag over one step of a constant command.
        self._share = 1.0 if time_constant == 0.0 else 1.0 - math.exp(-dt / time_constant)

    def __call__(self, command: float) -> float:
        self._given.append(command)
        late = self._given[len(self._given) - 1 - self._steps]
        self._output += self._share * (late - self._output)
        return self._output


# Random numbers


def splitmix64(seed: int, count: int) -> list[int]:
    """The first numbers of the SplitMix64 generator (Steele, Lea and Flood, 2014) in whole numbers."""
    mask, state, numbers = 2**64 - 1, seed, []
    for _ in range(count):
        state = (state + 0x9E3779B97F4A7C15) & mask
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        numbers.append(z ^ (z >> 31))
    return numbers


# Grids


def grid_to_world(track: Track, col: ArrayLike, row: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """(column, row) as floats → map frame [m]; a pixel's centre is at its index + 0.5."""
    u, v = np.asarray(col, np.float64) * track.resolution, np.asarray(row, np.float64) * track.resolution
    x, y, yaw = track.origin
    return x + math.cos(yaw) * u - math.sin(yaw) * v, y + math.sin(yaw) * u + math.cos(yaw) * v
