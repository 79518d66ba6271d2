"""Walls drawn from widths: pixel by pixel against the centreline's own projection."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.errors import OutlapError
from outlap.track.centerline import Centerline
from outlap.track.walls import draw_walls


def hairpin() -> Centerline:
    """Two straights 2 m apart and the bends that join them, with different and changing widths."""
    turn = np.linspace(-np.pi / 2.0, np.pi / 2.0, 12)
    right = np.column_stack([10.0 + np.cos(turn), 1.0 + np.sin(turn)])
    left = np.column_stack([-np.cos(turn), 1.0 - np.sin(turn)])
    bottom = np.column_stack([np.linspace(0.8, 9.2, 20), np.zeros(20)])
    top = np.column_stack([np.linspace(9.2, 0.8, 20), np.full(20, 2.0)])
    points = np.vstack([bottom, right[1:-1], top, left[1:-1]])
    return Centerline.from_points(points, np.linspace(0.4, 1.0, len(points)), 0.8)


@pytest.mark.parametrize("resolution", [0.05, 0.13])
def test_a_pixel_is_free_where_its_nearest_point_is_within_the_widths(resolution: float) -> None:
    line = hairpin()
    occupancy, (left, bottom, yaw) = draw_walls(line, resolution, margin=0.3)
    assert yaw == 0.0
    row, col = np.indices(occupancy.shape)
    s, d = line.to_frenet(left + (col + 0.5) * resolution, bottom + (row + 0.5) * resolution)
    width_right, width_left = line.widths(s)
    slack = np.minimum(width_left - d, d + width_right)  # positive within the widths
    sure = np.abs(slack) > 2e-3
    assert sure.mean() > 0.98
    np.testing.assert_array_equal(occupancy[sure], (slack < 0.0)[sure])
    border = math.floor(0.3 / resolution)
    inner = occupancy[border:-border, border:-border]
    assert inner.sum() + occupancy.size - inner.size == occupancy.sum()  # the margin is all wall


def test_width_and_area_of_a_ring_are_those_asked_for() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False)
    line = Centerline.from_points(20.0 * np.column_stack([np.cos(angle), np.sin(angle)]), 1.5, 0.5)
    occupancy, origin = draw_walls(line, 0.05, margin=0.5)
    # anticlockwise: right is outside
    assert (~occupancy).sum() * 0.05**2 == pytest.approx(np.pi * (21.5**2 - 19.5**2), rel=1e-3)
    assert origin[0] <= -22.0
    assert origin[0] + occupancy.shape[1] * 0.05 >= 22.0


@pytest.mark.parametrize(
    ("resolution", "margin", "message"),
    [
        (0.0, 0.5, "resolution is 0.0; it must be a positive"),
        (math.nan, 0.5, "resolution is nan"),
        (0.0005, 0.5, "resolution is 0.0005; it makes .* pixels .* take a coarser"),
        (1e-9, 0.5, "resolution is 1e-09; .* take a coarser"),
        (0.05, -1.0, "margin is -1.0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(resolution: float, margin: float, message: str) -> None:
    with pytest.raises(OutlapError, match=message):
        draw_walls(hairpin(), resolution, margin)
