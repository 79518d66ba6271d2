"""A track driven the other way round, and in a mirror."""

from __future__ import annotations

import numpy as np
import pytest

from oracles import grid_to_world
from outlap.track.catalog import load_tracks
from outlap.track.generate import generate_track
from outlap.track.raceline import Raceline
from outlap.track.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    """A random circuit, its grid turned about its corner, with a racing line."""
    made = generate_track(seed=3, length=160.0, resolution=0.1)
    s = np.linspace(0.0, 150.0, 40)
    x, y = made.centerline.position(s).T
    line = Raceline(s, x, y, made.centerline.heading(s), made.centerline.curvature(s), np.full(40, 5.0), np.zeros(40))
    return Track(made.name, made.occupancy, made.resolution, made.origin, made.centerline, line)


def test_reversed_runs_back_along_the_same_points(track: Track) -> None:
    back = track.reversed()
    length = track.centerline.length
    s = np.linspace(0.0, length, 300)
    assert back.centerline.length == pytest.approx(length, rel=1e-9)
    np.testing.assert_allclose(back.centerline.position(s), track.centerline.position(length - s), atol=1e-6)
    np.testing.assert_allclose(back.centerline.curvature(s), -track.centerline.curvature(length - s), atol=1e-4)
    right, left = back.centerline.widths(s)
    forth_right, forth_left = track.centerline.widths(length - s)
    np.testing.assert_allclose((right, left), (forth_left, forth_right), atol=1e-9)
    assert back.raceline is None
    np.testing.assert_array_equal(back.occupancy, track.occupancy)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_mirrored_has_every_wall_and_point_at_minus_x(track: Track, yaw: float) -> None:
    turned = Track(track.name, track.occupancy, track.resolution, (1.0, -2.0, yaw), track.centerline, track.raceline)
    mirror = turned.mirrored()
    rng = np.random.default_rng(0)
    height, width = track.occupancy.shape
    x, y = grid_to_world(turned, rng.uniform(-5, width + 5, 5000), rng.uniform(-5, height + 5, 5000))
    np.testing.assert_array_equal(mirror.is_wall(-x, y), turned.is_wall(x, y))
    s = np.linspace(0.0, track.centerline.length, 300)
    np.testing.assert_allclose(mirror.centerline.position(s), track.centerline.position(s) * [-1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(mirror.centerline.curvature(s), -track.centerline.curvature(s), atol=1e-9)
    line, mirrored = track.raceline, mirror.raceline
    assert line is not None
    assert mirrored is not None
    np.testing.assert_allclose(np.cos(mirrored.heading), -np.cos(line.heading), atol=1e-12)
    np.testing.assert_allclose(np.sin(mirrored.heading), np.sin(line.heading), atol=1e-12)
    np.testing.assert_array_equal(mirrored.curvature, -line.curvature)


def test_four_tracks_of_one(track: Track) -> None:
    names = [seen.name for seen in load_tracks([track], augment=True)]
    assert names == [track.name + way for way in ("", " mirrored", " reversed", " reversed mirrored")]
    assert load_tracks([track]) == (track,)
