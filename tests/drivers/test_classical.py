"""Drivers that need no training: what they do in one situation, and that they lap circuits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.drivers.classical import FollowTheGap, PurePursuit
from outlap.drivers.find import UNTRAINED, find_drivers
from outlap.envs.observations import LINE_AHEAD
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.simulator.vehicle import VehicleParams
from outlap.track import load_track
from outlap.track.generate import BUILTIN_HELD_OUT

SPAN = np.array([[0.4, 0.0, 8.0]], np.float32)  # full lock [rad], slowest, fastest [m/s]
PLAIN = {"lookahead_time": 0.0, "yaw_rate_gain": 0.0, "understeer": 0.0}  # pursuit and nothing else
ANGLES = np.linspace(-2.35, 2.35, 109)


def line(x, y, speed=3.0) -> np.ndarray:
    """The observation of a line ahead, given as functions of the arc length."""
    s = np.array(LINE_AHEAD)
    return np.stack([x(s), y(s), np.full_like(s, speed)], -1).reshape(1, -1)


def pursue(ahead: np.ndarray, forward: float = 2.0, leftward=0.0, yaw_rate=0.0, **settings: float) -> np.ndarray:
    vel = np.array([[forward, leftward, yaw_rate]])
    return PurePursuit(**settings).act({"line_ahead": ahead, "vel": vel, "action_span": SPAN})[0]  # type: ignore[arg-type]


def test_on_a_straight_line_it_steers_straight_at_the_lines_speed():
    steer, speed = pursue(line(lambda s: s, lambda s: 0.0 * s, speed=6.0))
    assert steer == 0.0
    assert speed == pytest.approx(2 * 6.0 / 8.0 - 1)


@pytest.mark.parametrize("radius", [-4.0, 3.0])
def test_on_a_circle_it_steers_the_circles_curvature(radius):
    arc = line(lambda s: radius * np.sin(s / radius), lambda s: radius * (1 - np.cos(s / radius)))
    steer, _ = pursue(arc, yaw_rate=2.0 / radius, lookahead=1.0, **PLAIN)
    assert steer == pytest.approx(math.atan(0.33 / radius) / 0.4, rel=0.02)


def test_a_car_that_slides_along_the_line_steers_straight():
    """Its nose points 0.2 rad to the left of the line, and it moves along it."""
    ahead = line(lambda s: s * math.cos(0.2), lambda s: -s * math.sin(0.2))
    steer, _ = pursue(ahead, forward=5.0 * math.cos(0.2), leftward=-5.0 * math.sin(0.2))
    assert steer == pytest.approx(0.0, abs=1e-6)


def test_a_tail_that_comes_round_is_caught():
    """On a straight, turning to the left: it steers to the right, and the more the faster it turns."""
    straight = line(lambda s: s, lambda s: 0.0 * s)
    slow, fast = (pursue(straight, forward=6.0, yaw_rate=rate)[0] for rate in (0.5, 1.0))
    assert fast < slow < 0.0


def test_far_from_the_line_it_looks_farther_ahead():
    """1.3 m beside a straight: over 4 m, where 0.4 m would have it turn across."""
    far = line(lambda s: s, lambda s: 0.0 * s + 1.3)
    steer, _ = pursue(far, 1.0, **PLAIN)
    distance = 0.4 + 4.0 * (1.3 - 0.3)
    assert math.tan(0.4 * steer) / 0.33 == pytest.approx(2 * 1.3 / distance**2, rel=0.02)


def test_it_turns_towards_a_line_beside_it_and_less_so_the_faster_it_is():
    beside = line(lambda s: s, lambda s: 0.0 * s + 0.1)
    slow, fast = (pursue(beside, speed, yaw_rate_gain=0.0)[0] for speed in (0.0, 6.0))
    assert slow > 2.0 * fast > 0.0


def test_the_arc_goes_through_the_point_at_the_lookahead_distance():
    """Of the circle through the car, tangent to its heading, and that point: κ = 2 y / d²."""
    steer, _ = pursue(line(lambda s: s, lambda s: 0.0 * s + 0.3), 2.0, lookahead=1.0, **PLAIN)
    assert math.tan(0.4 * steer) / 0.33 == pytest.approx(2 * 0.3 / 1.0**2, rel=0.1)


def head(ranges: np.ndarray) -> np.ndarray:
    return FollowTheGap().act({"scan": ranges[None], "action_span": SPAN})[0]


def test_in_the_open_it_goes_straight_and_fast():
    steer, speed = head(np.full(109, 10.0))
    assert steer == pytest.approx(0.0, abs=0.05)
    assert speed > 0.9


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_it_heads_for_the_side_that_is_free(side):
    ranges = np.where(side * ANGLES > 0.1, 8.0, 2.0)
    steer, _ = head(ranges)
    assert side * steer > 0.3


def test_it_brakes_before_a_wall():
    far, near = head(np.full(109, 6.0))[1], head(np.full(109, 1.0))[1]
    assert far > near
    assert near == pytest.approx(2 * math.sqrt(2 * 4.0 * 1.0) / 8.0 - 1, abs=0.1)


def test_it_does_not_aim_through_a_gap_that_it_does_not_fit_through():
    """Two beams see far between posts 0.3 m apart at 2 m; to the left 4 m are free."""
    ranges = np.full(109, 2.0)
    ranges[np.abs(ANGLES) < 0.07] = 10.0
    ranges[(ANGLES > 0.6) & (ANGLES < 1.5)] = 4.0
    assert head(ranges)[0] > 0.3


@pytest.mark.parametrize("name", sorted(UNTRAINED))
def test_they_lap_a_circuit(name):
    track = load_track(BUILTIN_HELD_OUT[-1])
    task = RaceConfig(beams=108, control_interval=4, speed_range=(0.0, 6.0), vehicle=VehicleParams(v_max=6.0))
    (driver,) = find_drivers([name], task.field_of_view)
    rows = evaluate(driver, standing_starts(task, [track], laps=1), [track], episodes=5, seed=0)
    assert rows["outcome"].tolist() == ["finished"] * 5
    assert rows["mean_speed_mps"].to_numpy().mean() > 2.0


def test_an_unknown_driver_is_named():
    with pytest.raises(OutlapError, match=r"driver is 'stig'; must be .*pure-pursuit"):
        find_drivers(["stig"], 4.7)
