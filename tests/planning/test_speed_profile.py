"""Speeds along a line: closed forms, and a slow oracle that relaxes every limit until none is broken."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from outlap.planning.limits import CarLimits
from outlap.planning.speed_profile import lap_time, speed_profile
from outlap.simulator.vehicle import VehicleParams

CAR = CarLimits.of(VehicleParams())
SPACING = 0.05


def stadium_curvature(straight: float, radius: float) -> np.ndarray:
    """Two straights and two half circles, sampled every SPACING."""
    half = [np.zeros(round(straight / SPACING)), np.full(round(math.pi * radius / SPACING), 1.0 / radius)]
    return np.concatenate(half * 2)


@pytest.mark.parametrize(("mu", "radius"), [(1.0489, 4.0), (0.5, 10.0)])
def test_a_circle_is_driven_at_the_limit_of_grip(mu, radius):
    curvature = np.full(500, 1.0 / radius)
    speed = speed_profile(curvature, 2.0 * math.pi * radius / 500, replace(CAR, mu=mu))
    np.testing.assert_allclose(speed, math.sqrt(mu * 9.81 * radius))


def test_a_stadium_takes_what_the_closed_form_says():
    """Corners at sqrt(mu g R); straights: accelerate to v_p and brake, v_p² = v_c² + a L, below v_switch and v_max."""
    car, straight, radius = replace(CAR, mu=0.6, a_max=4.0, a_brake=4.0, v_switch=20.0), 12.0, 3.0
    speed = speed_profile(stadium_curvature(straight, radius), SPACING, car)
    corner = math.sqrt(0.6 * 9.81 * radius)
    peak = math.sqrt(corner**2 + 4.0 * straight)
    expected = 2.0 * (2.0 * (peak - corner) / 4.0 + math.pi * radius / corner)
    assert lap_time(speed, SPACING) == pytest.approx(expected, rel=0.01)
    assert speed.max() == pytest.approx(peak, rel=0.01)


def test_braking_and_accelerating_have_limits_of_their_own():
    car = replace(CAR, mu=2.0, a_max=2.0, a_brake=8.0, v_max=50.0, v_switch=50.0)
    speed = speed_profile(stadium_curvature(20.0, 2.0), SPACING, car)
    acceleration = (np.roll(speed, -1) ** 2 - speed**2) / (2.0 * SPACING)
    assert acceleration.max() == pytest.approx(2.0, rel=1e-6)
    assert acceleration.min() == pytest.approx(-8.0, rel=1e-6)


def test_above_v_switch_power_is_what_limits():
    """a v = a_max v_switch: from v_switch on, v³ grows by 3 P for every metre."""
    car = replace(CAR, mu=3.0, v_switch=4.0, v_max=50.0, a_brake=1000.0)
    speed = speed_profile(stadium_curvature(40.0, 1.0), SPACING, replace(car, a_brake=25.0))
    straight = speed[: round(30.0 / SPACING)]
    above = straight[straight > 4.2][:200]
    power = np.diff(above**3) / 3.0 / SPACING
    np.testing.assert_allclose(power, car.a_max * 4.0, rtol=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_every_speed_is_the_largest_that_its_limits_and_neighbours_allow(seed):
    """The square of each is the least of v_max, cornering, and what the neighbours can accelerate to or brake from."""
    rng = np.random.default_rng(seed)
    n, h = 240, 0.1
    curvature = np.interp(np.arange(n), np.arange(12) * 20, rng.normal(0.0, 0.4, 12), period=n)
    mu = np.interp(np.arange(n), np.arange(24) * 10, 0.5 + 0.6 * rng.random(24), period=n)
    car = replace(CAR, a_max=6.0, a_brake=5.0, v_max=9.0, v_switch=5.0)
    square = speed_profile(curvature, h, car, mu) ** 2
    for i in range(n):
        before, after = (i - 1) % n, (i + 1) % n
        limits = {"v_max": 81.0, "cornering": 9.81 * mu[i] / max(abs(curvature[i]), 1e-9)}
        for name, j, most in (("accelerating", before, 6.0), ("braking", after, 5.0)):
            grip = 9.81 * mu[j]
            along = min(most, grip) * math.sqrt(max(0.0, 1.0 - (square[j] * curvature[j] / grip) ** 2))
            if name == "accelerating" and square[j] > 25.0:
                along = min(along, 6.0 * 5.0 / math.sqrt(square[j]))
            limits[name] = square[j] + 2.0 * h * along
        assert square[i] == pytest.approx(min(limits.values()), rel=1e-3), (i, limits)
