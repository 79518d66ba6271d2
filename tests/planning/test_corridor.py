"""Corridors and margins against brute force on the map's cells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from oracles import grid_to_world
from outlap.errors import OutlapError
from outlap.planning.corridor import corridor, wall_margin
from outlap.planning.limits import CarLimits
from outlap.planning.path import path_along
from outlap.simulator.vehicle import VehicleParams
from outlap.track import Track
from synthetic_tracks import ring

CAR = CarLimits.of(VehicleParams())


def cells_to_point(track: Track, x: float, y: float) -> float:
    """Distance from a point to the nearest wall cell's square [m], cell by cell."""
    rows, cols = np.nonzero(track.occupancy)
    col, row = track.world_to_grid(x, y)
    dx = np.maximum(np.abs(cols + 0.5 - col) - 0.5, 0.0)
    dy = np.maximum(np.abs(rows + 0.5 - row) - 0.5, 0.0)
    return float(np.min(np.hypot(dx, dy))) * track.resolution


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_disc_at_either_end_of_the_corridor_touches_a_wall_or_the_widths(yaw):
    track, radius = ring(6.0, yaw=yaw), 0.3
    path = path_along(track.centerline, 0.5)
    right, left = corridor(track, path, radius)
    limit = 1.2 - radius
    for i in range(0, len(path.points), 3):
        for end, way in ((right[i], -1.0), (left[i], 1.0)):
            at, beyond = (path.points[i] + d * path.normal[i] for d in (end, end + 0.01 * way))
            assert cells_to_point(track, *at) >= radius - 1e-9
            assert abs(end) <= limit + 1e-6
            assert cells_to_point(track, *beyond) < radius or abs(end + 0.01 * way) > limit


def test_a_line_beside_a_pillar_is_led_to_the_side_where_there_is_room():
    """A pillar on the centreline: the interval lies to one side of it, and the line is not in it."""
    track = ring(6.0)
    walls = track.occupancy.copy()
    col, row = (int(v) for v in track.world_to_grid(6.0, 0.0))
    walls[row - 3 : row + 4, col - 3 : col + 4] = True
    blocked = Track("pillar", walls, track.resolution, track.origin, track.centerline)
    right, left = corridor(blocked, path_along(track.centerline, 0.5), 0.25)
    assert right[0] * left[0] > 0.0
    assert abs(right[0]) >= 0.15 + 0.25 - 0.06
    assert right[len(right) // 2] < 0.0 < left[len(left) // 2]


def test_a_track_that_is_too_narrow_says_where():
    track = ring(6.0)
    walls = track.occupancy.copy()
    x, y = 6.0 * math.cos(1.0), 6.0 * math.sin(1.0)
    height, width = walls.shape
    cx, cy = grid_to_world(track, *np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
    walls |= (np.hypot(cx - x, cy - y) < 1.3) & (np.hypot(cx, cy) > 5.2)
    narrow = Track("narrow", walls, track.resolution, track.origin, track.centerline)
    with pytest.raises(OutlapError, match=r"track narrow: at s = \d\.\d m it is narrower than 0\.70 m"):
        corridor(narrow, path_along(track.centerline, 0.2), 0.35)


def test_the_margin_is_the_distance_of_the_rectangle_from_the_nearest_cell():
    track = ring(6.0, resolution=0.1, yaw=0.4)
    inside = ring(5.5)
    path = path_along(inside.centerline, 3.0)
    found = wall_margin(track, path, CAR)
    for i in range(len(path.points)):
        u, v = np.meshgrid(np.linspace(-0.29, 0.29, 59), np.linspace(-0.155, 0.155, 32))
        cos, sin = math.cos(path.heading[i]), math.sin(path.heading[i])
        x, y = path.points[i, 0] + cos * u - sin * v, path.points[i, 1] + sin * u + cos * v
        rim = np.ones_like(u, bool)
        rim[1:-1, 1:-1] = False
        exact = min(cells_to_point(track, *point) for point in zip(x[rim][::3], y[rim][::3], strict=True))
        assert found[i] == pytest.approx(exact, abs=0.01)


def test_a_rectangle_in_a_wall_has_a_negative_margin():
    track = ring(6.0)
    outside = ring(6.0 + 1.2)
    assert (wall_margin(track, path_along(outside.centerline, 1.0), CAR) < 0.0).all()


def test_without_walls_there_is_nothing_to_come_near_to():
    track = ring(6.0)
    open_ground = Track("open", np.zeros_like(track.occupancy), track.resolution, track.origin, track.centerline)
    assert np.isinf(wall_margin(open_ground, path_along(track.centerline, 2.0), CAR)).all()
