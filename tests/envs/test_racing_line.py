"""The reference speed: from a raceline, and from friction where there is none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from outlap.envs.racing_line import LINE_SPEED, racing_lines
from outlap.planning.limits import CarLimits
from outlap.simulator.atlas import FIRST_ROW, LINE_SPACING, ROWS, build_atlas
from outlap.simulator.vehicle import VehicleParams
from outlap.track.centerline import Centerline
from outlap.track.raceline import Raceline
from outlap.track.track import Track

GRAVITY = 9.81


def profile(*tracks: Track, **vehicle: Any) -> list[np.ndarray]:
    """The reference speeds of each track [m/s]."""
    atlas = build_atlas(tracks)
    speeds = racing_lines(tracks, atlas, CarLimits.of(VehicleParams(**vehicle)), "track")[:, LINE_SPEED]
    assert speeds.shape == (len(atlas.line),)
    return [speeds[first : first + rows] for first, rows in atlas.index[:, [FIRST_ROW, ROWS]]]


def on_open_ground(line: Centerline, name: str = "plain") -> Track:
    """A track without walls worth the name: only its line matters here."""
    return Track(name, np.zeros((4, 4), bool), 50.0, (-100.0, -100.0, 0.0), line)


@pytest.fixture(scope="module")
def stadium() -> Track:
    """Two straights of 40 m and two half circles of 3 m, with the start in the middle of a straight."""
    straight = np.arange(-20.0, 20.0, 0.25)
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 60, endpoint=False)
    half = np.concatenate([
        np.stack([straight, np.full_like(straight, -3.0)], 1),
        np.stack([20.0 + 3.0 * np.cos(angle), 3.0 * np.sin(angle)], 1),
    ])  # fmt: skip
    points = np.roll(np.concatenate([half, -half]), -80, axis=0)
    return on_open_ground(Centerline.from_points(points, 1.0, 1.0), "stadium")


@pytest.mark.parametrize("mu", [0.5, 0.8, 1.0489])
def test_a_circle_is_driven_at_the_speed_that_asks_for_its_share_of_the_grip(circle, big_circle, mu):
    """v² / R = 0.8 mu g everywhere, on each of several tracks."""
    for track_radius, speeds in zip((8.0, 4.0), profile(big_circle, circle, mu=mu), strict=True):
        np.testing.assert_allclose(speeds, math.sqrt(0.8 * mu * GRAVITY * track_radius), rtol=2e-3)


def test_nowhere_faster_than_the_car(big_circle):
    np.testing.assert_allclose(profile(big_circle, v_max=5.0)[0], 5.0)


def test_the_car_brakes_before_a_corner_and_accelerates_out_of_it(stadium):
    """On the straight v² = v_corner² + 2 a x, with x the way to the nearer corner: 20 m from the middle."""
    mu, a_max = 0.9, 4.0
    speeds = profile(stadium, mu=mu, a_max=a_max, v_switch=20.0)[0]
    spacing = stadium.centerline.length / len(speeds)
    corner = 0.8 * mu * GRAVITY * 3.0
    for x in (0.0, 5.0, 10.0):  # nearer to the corner the line begins to bend
        for index in (round(x / spacing), -round(x / spacing)):
            assert speeds[index] == pytest.approx(math.sqrt(corner + 2.0 * a_max * (20.0 - x)), rel=0.01)
    middle_of_the_corner = round((20.0 + 1.5 * math.pi) / spacing)
    assert speeds[middle_of_the_corner] == pytest.approx(math.sqrt(corner), rel=0.01)


@pytest.mark.parametrize(("mu", "a_max"), [(1.0489, 9.51), (0.9, 4.0), (0.5, 9.51)])
def test_no_limit_is_broken_and_none_is_wasted(stadium, ellipse, mu, a_max):
    """Everywhere within the three limits, all around the loop, and at one of them."""
    v_max = 9.0
    tracks = (stadium, ellipse)
    for track, speeds in zip(tracks, profile(*tracks, mu=mu, a_max=a_max, v_max=v_max), strict=True):
        curvature = np.abs(track.centerline.table(LINE_SPACING)["curvature"])
        squared = speeds.astype(float) ** 2
        step = 2.0 * track.centerline.length / len(speeds)
        grip = 0.8 * mu * GRAVITY
        along = min(a_max, grip)
        cornering = squared * curvature / grip
        gained = (np.roll(squared, -1) - squared) / step / along
        lost = (np.roll(squared, 1) - squared) / step / along  # braking is seen from where it ends
        power = np.where(speeds > 7.319, a_max * 7.319 / speeds / along, np.inf)
        accelerating = np.maximum(np.hypot(np.maximum(gained, 0.0), cornering), gained / power)
        braking = np.hypot(np.maximum(lost, 0.0), cornering)
        used = np.max([accelerating, np.roll(accelerating, 1), braking, np.roll(braking, -1), speeds / v_max], axis=0)
        assert max(cornering.max(), accelerating.max(), braking.max()) < 1.0 + 1e-3, "a limit is broken"
        assert used.min() > 1.0 - 1e-3, "faster were possible"
        assert squared.max() - squared.min() > 5.0, "the test needs a track with fast and slow places"


def test_a_racelines_speed_is_looked_up_where_its_points_lie(big_circle):
    """It starts elsewhere, runs wide of the centreline and has its own arc length: only the place counts."""
    angle = 2.0 + np.linspace(0.0, 2.0 * math.pi, 300, endpoint=False)
    radius = 8.0 + 0.4 * np.cos(3.0 * angle)
    speed = 5.0 + 2.0 * np.cos(angle)
    zero = np.zeros(300)
    raceline = Raceline(radius * angle, radius * np.cos(angle), radius * np.sin(angle), zero, zero, speed, zero)
    track = replace(big_circle, raceline=raceline)
    for speeds in (profile(track)[0], profile(big_circle, track, mu=0.3, v_max=2.0)[1]):
        s = np.arange(len(speeds)) * track.centerline.length / len(speeds)
        np.testing.assert_allclose(speeds, 5.0 + 2.0 * np.cos(s / 8.0), atol=5e-3)
