"""Where a car fits: how far it can stand left and right of a line, and how near a driven line comes to the walls.

A car that follows a line turns with it, and so its middle keeps half its width from whatever its sides pass: where a
disc as wide as the car fits, the car does, but for its corners, which on the outside of a bend of curvature k stand out
by about length² k / 8. The disc is turned nowhere, so that corridors do not depend on the line that is sought.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import KDTree

from outlap.errors import OutlapError
from outlap.planning.limits import CarLimits
from outlap.planning.path import ClosedPath
from outlap.track.track import Track

LATERAL_STEP = 0.02  # [m] between places that are tried; less than a pixel of any map
PROJECTIONS = 12  # on the centreline, at most, until the widths' ends are found
LARGEST_MOVE = 0.5  # [m] from one of them to the next
EXACT = 1e-3  # [m] to which the ends are found
BODY_STEP = 0.03  # [m] between points of the car's body


def corridor(track: Track, path: ClosedPath, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how far a disc may move sideways from each point of a line.

    What counts is the map; the centreline's widths only say where a track ends that has no wall there.

    Args:
        track: whose walls and widths these are.
        path: the line.
        radius: of the disc: half the car's width, and what it is to keep from the walls [m].

    Returns:
        right, left: (n,) [m], both positive to the left: the ends of the free interval nearest to the line. Where the
        disc does not fit on the line itself, they have the same sign.

    Raises OutlapError, with the arc length along the centreline, where the disc fits nowhere.
    """
    within_right, within_left = _within_the_widths(track, path, radius)
    frame = np.array([*track.origin[:2], math.cos(track.origin[2]), math.sin(track.origin[2]), track.resolution])
    right, left = _free_intervals(track.occupancy, frame, path.points, path.normal, radius, within_right, within_left)
    nowhere = np.flatnonzero(np.isnan(right))
    if len(nowhere):
        s = float(track.centerline.to_frenet(*path.points[nowhere[0]])[0])
        raise OutlapError(
            f"track {track.name}: at s = {s:.1f} m it is narrower than {2.0 * radius:.2f} m, the car's width and the "
            "margin on either side; take a smaller margin, or a narrower car"
        )
    return right, left


def wall_margin(track: Track, path: ClosedPath, body: CarLimits) -> np.ndarray:
    """Return the distance from the car's body to the nearest wall along a line: (n,) [m], negative inside a wall."""
    half_length, half_width = 0.5 * body.length, 0.5 * body.width
    step = min(BODY_STEP, track.resolution)  # no pixel is stepped over
    lengthwise = np.linspace(-half_length, half_length, math.ceil(body.length / step) + 1)
    crosswise = np.linspace(-half_width, half_width, math.ceil(body.width / step) + 1)
    u, v = (each.ravel() for each in np.meshgrid(lengthwise, crosswise))
    cos, sin = np.cos(path.heading)[:, None], np.sin(path.heading)[:, None]
    x = path.points[:, :1] + cos * u - sin * v
    y = path.points[:, 1:] + sin * u + cos * v
    inside = track.is_wall(x, y).any(axis=1)
    rim = (np.abs(u) == half_length) | (np.abs(v) == half_width)
    col, row = track.world_to_grid(x[:, rim], y[:, rim])
    cells = _shore(track.occupancy)
    if not len(cells):
        return np.full(len(x), np.inf)
    _, near = KDTree(cells + 0.5).query(np.stack([col, row], axis=-1), k=4)
    near = np.minimum(near, len(cells) - 1)  # should there be fewer than four
    away_x = np.maximum(np.abs(cells[near, 0] + 0.5 - col[..., None]) - 0.5, 0.0)
    away_y = np.maximum(np.abs(cells[near, 1] + 0.5 - row[..., None]) - 0.5, 0.0)
    distance = np.hypot(away_x, away_y).min(axis=(1, 2)) * track.resolution
    return np.where(inside, -track.resolution, distance)  # how deep does not matter


def _within_the_widths(track: Track, path: ClosedPath, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the interval beside each point in which a disc is within the widths: two (n,) [m], left positive.

    Where there is no room, the right one is farther to the left.
    """
    ends = []
    for way in (-1.0, 1.0):
        end = np.zeros(len(path.points))
        for _ in range(PROJECTIONS):  # to the offset at which the disc reaches the width
            s, d = track.centerline.to_frenet(*path.shifted(end).T)
            right, left = track.centerline.widths(s)
            lacking = (left - radius if way > 0.0 else radius - right) - d
            end += np.clip(lacking, -LARGEST_MOVE, LARGEST_MOVE)
            if np.abs(lacking).max() < EXACT:
                break
        ends.append(end)
    return ends[0], ends[1]


@njit(cache=True, error_model="numpy")
def _free_intervals(occupancy, frame, points, normal, radius, low, high):
    """The interval of offsets within [low, high], nearest to 0, in which a disc meets no wall: two (n,), NaN: none."""
    right = np.full(len(points), np.nan)
    left = np.full(len(points), np.nan)
    for i in range(len(points)):
        if low[i] > high[i]:
            continue
        x, y = points[i]
        nx, ny = normal[i]
        nearest = min(max(0.0, low[i]), high[i])
        begin = nearest
        k = 0
        while not _is_free(occupancy, frame, x + begin * nx, y + begin * ny, radius):
            k += 1
            away = LATERAL_STEP * ((k + 1) // 2) * (1.0 if k % 2 else -1.0)  # alternately left and right, ever farther
            begin = min(max(nearest + away, low[i]), high[i])
            if abs(away) > high[i] - low[i] + LATERAL_STEP:
                begin = np.nan
                break
        if math.isnan(begin):
            continue
        for way in (-1.0, 1.0):
            end = low[i] if way < 0.0 else high[i]
            free = begin
            while free != end:
                ahead = free + way * min(LATERAL_STEP, abs(end - free))
                if abs(ahead - end) < 1e-9:
                    ahead = end
                if _is_free(occupancy, frame, x + ahead * nx, y + ahead * ny, radius):
                    free = ahead
                    continue
                while abs(ahead - free) > EXACT:
                    middle = 0.5 * (ahead + free)
                    if _is_free(occupancy, frame, x + middle * nx, y + middle * ny, radius):
                        free = middle
                    else:
                        ahead = middle
                break
            if way < 0.0:
                right[i] = free
            else:
                left[i] = free
    return right, left


@njit(cache=True, error_model="numpy")
def _is_free(occupancy, frame, x, y, radius):
    """Whether a disc about (x, y) [m] touches no wall cell's square; what lies outside the map is wall."""
    height, width = occupancy.shape
    origin_x, origin_y, cos, sin, resolution = frame
    col = (cos * (x - origin_x) + sin * (y - origin_y)) / resolution
    row = (cos * (y - origin_y) - sin * (x - origin_x)) / resolution
    r = radius / resolution
    if not (r <= col <= width - r and r <= row <= height - r):
        return False
    for j in range(int(row - r), min(int(row + r), height - 1) + 1):
        dy = max(j - row, row - (j + 1.0), 0.0)
        for i in range(int(col - r), min(int(col + r), width - 1) + 1):
            if occupancy[j, i]:
                dx = max(i - col, col - (i + 1.0), 0.0)
                if dx * dx + dy * dy < r * r:
                    return False
    return True


def _shore(occupancy: np.ndarray) -> np.ndarray:
    """Wall cells beside a free one: (n, 2) column, row."""
    inner = np.asarray(ndimage.minimum_filter(occupancy, size=3, mode="nearest"), bool)
    rows, cols = np.nonzero(occupancy & ~inner)
    return np.column_stack([cols, rows]).astype(np.float64)
