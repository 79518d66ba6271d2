"""Closed forms of the bicycle model, and when the single track must become kinematic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cars import rolling, small_row
from outlap.simulator.bicycle import axle_loads, lateral_rate
from outlap.simulator.dynamics import (
    EULER,
    KINEMATIC,
    RK4,
    SINGLE_TRACK,
    integrate,
    kinematic_speed,
    rolling_wheel_speeds,
    single_track,
)


def test_kinematic_car_drives_a_circle_of_the_radius_that_geometry_gives():
    # The rear axle's circle has radius l / tan(steer); the centre of gravity is lr in front of that axle.
    row, steer, speed = small_row(), 0.3, 2.0
    wheelbase = row["lf"] + row["lr"]
    radius = math.hypot(row["lr"], wheelbase / math.tan(steer))
    steps = 200
    dt = 2 * math.pi * radius / speed / steps
    state = rolling(speed, row, steer)
    path = []
    for _ in range(steps):
        state = integrate(KINEMATIC, RK4, state, 0.0, 0.0, dt, row)
        path.append(state[:2])
    points = np.array(path)
    assert state[5] == pytest.approx(speed / radius, rel=1e-12)
    np.testing.assert_allclose(points[-1], [0, 0], atol=1e-6)  # back where it started
    centre = points.mean(axis=0)
    np.testing.assert_allclose(np.hypot(*(points - centre).T), radius, rtol=1e-6)


@pytest.mark.parametrize("speed", [-3.0, 0.4, 8.0])
@pytest.mark.parametrize("model", [KINEMATIC, SINGLE_TRACK])
def test_braking_distance_on_a_straight(model, speed):
    row = small_row()
    push = -math.copysign(5.0, speed)
    steps = 40
    dt = speed / -push / steps
    row["kinematic_speed"] = kinematic_speed(row, dt)
    state = rolling(speed, row)
    for _ in range(steps):
        state = integrate(model, RK4, state, 0.0, push, dt, row)
    assert state[0] == pytest.approx(speed * abs(speed) / (2 * 5.0), rel=1e-12)
    assert state[1] == 0.0
    assert state[3] == pytest.approx(0.0, abs=1e-12)


def test_steady_cornering_follows_the_understeer_gradient():
    # Textbook: steer = l / R + front - rear slip angle, each lateral force over stiffness.
    row, steer, speed = small_row(), 0.05, 5.0
    state = rolling(speed, row, steer)
    for _ in range(500):
        state = integrate(SINGLE_TRACK, RK4, state, 0.0, 0.0, 0.01, row)
    lateral = state[5] * speed / 9.81  # [g]
    front = lateral / (row["mu"] * row["C_Sf"])
    rear = lateral / (row["mu"] * row["C_Sr"])
    wheelbase = row["lf"] + row["lr"]
    assert steer == pytest.approx(wheelbase * state[5] / speed + front - rear, rel=1e-9)


def test_axle_loads_balance_weight_and_pitching_moment():
    row = small_row()
    for push in (-9.0, 0.0, 9.0):
        front, rear = axle_loads(push, row)
        assert front + rear == pytest.approx(9.81)
        moment = front * row["lf"] - rear * row["lr"] + push * row["h"]
        assert moment == pytest.approx(0.0, abs=1e-12)
    assert axle_loads(1000.0, row) == (0.0, 9.81)
    assert axle_loads(-1000.0, row) == (9.81, 0.0)


def test_wheels_roll_with_the_velocity_of_their_axle():
    row, steer, speed, yaw_rate, slip = small_row(), 0.3, 4.0, 1.5, -0.2
    at_front = np.array([speed * math.cos(slip), speed * math.sin(slip) + row["lf"] * yaw_rate])
    front, rear = rolling_wheel_speeds(steer, speed, yaw_rate, slip, row)
    assert front * row["wheel_radius"] == pytest.approx(at_front @ [math.cos(steer), math.sin(steer)])
    assert rear * row["wheel_radius"] == pytest.approx(at_front[0])


def lateral_modes(speed, push, row):
    """Eigenvalues of the (yaw rate, slip) dynamics, by differences (the model is linear in both)."""

    def rates(yaw_rate, slip):
        return np.array(single_track((0.0, 0.0, 0.0, speed, 0.0, yaw_rate, slip, 0.0, 0.0), 0.0, push, row)[5:7])

    return np.linalg.eigvals(np.column_stack([rates(1.0, 0.0), rates(0.0, 1.0)]) - rates(0.0, 0.0)[:, None])


changes = st.floats(0.6, 1.6)


@settings(deadline=None)
@given(changes, changes, changes, changes, changes, changes, st.floats(-3.0, 3.0), st.sampled_from([1.0, -1.0]))
def test_lateral_rate_is_the_fastest_eigenvalue_at_low_speed(mu, front, rear, lf, mass, inertia, push, way):
    row = small_row()
    row["kinematic_speed"] = 0.1
    factors = {"mu": mu, "C_Sf": front, "C_Sr": rear, "lf": lf, "m": mass, "I": inertia}
    for name, factor in factors.items():
        row[name] *= factor
    loads = axle_loads(push, row)
    front_stiffness = row["mu"] * row["C_Sf"] * loads[0]
    rear_stiffness = row["mu"] * row["C_Sr"] * loads[1]
    expected = lateral_rate(front_stiffness, rear_stiffness, row)
    modes = lateral_modes(way * 0.1, push, row)
    assert np.all(modes.real < 0)  # stable in both directions
    assert np.max(np.abs(modes)) * 0.1 == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize(("integrator", "limit"), [(RK4, 2.785), (EULER, 2.0)])
@pytest.mark.parametrize("dt", [0.02, 0.04])
def test_the_single_track_is_stable_above_its_kinematic_speed_and_not_far_below(integrator, limit, dt):
    row = small_row()

    def left_after(speed):  # of a disturbance: yaw rate [rad/s]
        row["kinematic_speed"] = 0.1
        state = (0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.2, 0.0, 0.0)
        for _ in range(100):
            state = integrate(SINGLE_TRACK, integrator, state, 0.0, 0.0, dt, row)
        return abs(state[5])

    threshold = kinematic_speed(row, dt, integrator)
    assert threshold > 0.5
    assert left_after(threshold) < 1e-3
    loads = axle_loads(0.0, row)
    rate = lateral_rate(row["mu"] * row["C_Sf"] * loads[0], row["mu"] * row["C_Sr"] * loads[1], row)
    assert left_after(rate * dt / limit * 1.1) < 0.1
    assert left_after(rate * dt / limit * 0.9) > 10.0  # so a bound is needed


def test_kinematic_speed_is_at_least_the_gyms():
    assert kinematic_speed(small_row(), 0.001) == 0.5


def test_crossing_the_switch_up_and_down_loses_nothing():
    row = small_row()
    state = rolling(0.0, row, 0.2)
    for push in (2.0, -2.0):
        for _ in range(100):
            before = state
            state = integrate(SINGLE_TRACK, RK4, state, 0.0, push, 0.01, row)
            assert abs(state[5] - before[5]) < 0.05  # yaw rate: at most 2 m/s^2 * tan(0.2) / l * dt, and lag
            assert abs(state[6] - before[6]) < 0.02
    assert state[3] == pytest.approx(0.0, abs=1e-12)
    assert state[5] == pytest.approx(0.0, abs=1e-12)
