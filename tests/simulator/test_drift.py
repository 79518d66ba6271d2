"""The drift model where the package does not go: spins, reversing, locked wheels; and where models agree."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cars import rolling, small_row
from outlap.simulator.bicycle import axle_loads
from outlap.simulator.drift import drift_substeps
from outlap.simulator.dynamics import DRIFT, EULER, RK4, SINGLE_TRACK, drift, integrate, kinematic_values
from outlap.simulator.tyre import tyre_forces


def energy(state, row):
    return 0.5 * (
        row["m"] * state[3] ** 2 + row["I"] * state[5] ** 2 + row["wheel_inertia"] * (state[7] ** 2 + state[8] ** 2)
    )


@settings(deadline=None, max_examples=30)
@given(st.floats(1.0, 8.0), st.floats(-3.1, 3.1), st.floats(-6.0, 6.0))
def test_a_spinning_car_loses_energy_and_ends_rolling(speed, slip, yaw_rate):
    row = small_row()
    wheel = max(0.0, speed * math.cos(slip)) / row["wheel_radius"]
    state = (0.0, 0.0, 0.0, speed, 0.0, yaw_rate, slip, wheel, wheel)
    start = lowest = energy(state, row)
    for _ in range(400):
        state = integrate(DRIFT, RK4, state, 0.0, 0.0, 0.01, row)
        now = energy(state, row)
        assert now <= lowest + 0.01 * start
        lowest = min(lowest, now)
    assert abs(state[5]) < 0.05
    assert abs(state[6]) < 0.05


def test_a_car_that_slides_backwards_to_a_halt_can_reverse_and_drive_on():
    row = small_row()
    state = (0.0, 0.0, 0.0, 2.0, 0.0, 0.0, math.pi, 0.0, 0.0)
    for _ in range(100):
        state = integrate(DRIFT, RK4, state, 0.0, 0.0, 0.01, row)
    assert -0.25 < state[3] <= 0.0  # it moves backwards, and says so
    assert state[0] < -0.1
    for _ in range(200):
        state = integrate(DRIFT, RK4, state, 0.0, 2.0, 0.01, row)
    assert state[3] > 2.0
    assert abs(state[6]) < 0.02


def test_reversing_is_kinematic():
    row = small_row()
    state = rolling(-1.0, row, 0.2)
    for _ in range(100):
        state = integrate(DRIFT, RK4, state, 0.1, -0.5, 0.01, row)
    yaw_rate, slip = kinematic_values(state[2], state[3], row)
    assert state[3] == pytest.approx(-1.5, abs=1e-6)
    assert state[5] == pytest.approx(yaw_rate, rel=1e-3)
    assert state[6] == pytest.approx(slip, rel=1e-2)
    assert state[7:] == (0.0, 0.0)


def test_locked_wheels_slide_with_the_friction_of_full_slip():
    # Hard braking locks all wheels; from then on the deceleration is what the tyres give at slip 1.
    row = small_row()
    row["a_max"] = 20.0
    state = rolling(15.0, row)
    for _ in range(60):
        state = integrate(DRIFT, RK4, state, 0.0, -20.0, 0.01, row)
    assert state[7:] == (0.0, 0.0)
    before = state[3]
    for _ in range(10):
        state = integrate(DRIFT, RK4, state, 0.0, -20.0, 0.01, row)
    mass = row["m"]
    front, rear = (tyre_forces(1.0, 0.0, mass * load, row)[0] for load in axle_loads(-20.0, row))
    assert (state[3] - before) / 0.1 == pytest.approx((front + rear) / mass, rel=0.01)
    assert 0.5 * 9.81 < (before - state[3]) / 0.1 < 1.2 * 9.81


def test_gentle_cornering_is_the_single_tracks_with_the_same_stiffness():
    row = small_row()
    row["C_Sf"] = row["C_Sr"] = -row["p_ky1"] / row["mu"]
    # The table's tyre pulls to one side; without its shifts it is symmetric.
    row["r_hx1"] = row["r_by3"] = row["r_hy1"] = row["r_vy1"] = row["p_hx1"] = 0.0
    ends = []
    for model in (SINGLE_TRACK, DRIFT):
        state = rolling(4.0, row, 0.02)
        for _ in range(50):
            state = integrate(model, RK4, state, 0.0, 0.0, 0.01, row)
        ends.append(np.array(state[:7]))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.02, atol=1e-4)


@settings(deadline=None)
@given(
    st.floats(-5.0, 20.0), st.floats(-0.42, 0.42), st.floats(-3.2, 3.2), st.floats(-50.0, 50.0),
    st.floats(0.0, 500.0), st.floats(0.0, 500.0), st.floats(-9.5, 9.5),
)  # fmt: skip
def test_derivatives_are_finite_in_any_state(speed, steer, slip, yaw_rate, front, rear, push):
    state = (0.0, 0.0, steer, speed, 0.0, yaw_rate, slip, front, rear)
    assert np.all(np.isfinite(drift(state, 3.2, push, small_row())))


def test_standing_start_reaches_the_speed_that_the_engine_gives():
    row, state = small_row(), (0.0,) * 9
    for _ in range(200):
        state = integrate(DRIFT, RK4, state, 0.0, 3.0, 0.01, row)
    # Part of the torque spins up the wheels: two axles of inertia I / r^2 beside the mass.
    wheels = 2 * row["wheel_inertia"] / row["wheel_radius"] ** 2
    assert state[3] == pytest.approx(6.0 * row["m"] / (row["m"] + wheels), rel=0.02)


def test_no_tyre_drives_a_car_faster_than_its_motor():
    """Coefficients far outside the table, whose combined slip gives forces many times the friction."""
    rng = np.random.default_rng(0)
    for _ in range(60):
        row = small_row()
        row["p_kx1"], row["r_cx1"], row["p_dy1"] = 1.7, rng.uniform(-1e3, 1e3), rng.uniform(0.01, 0.6)
        state = rolling(rng.uniform(0.5, 20.0), row)
        for _ in range(60):
            state = integrate(DRIFT, RK4, state, rng.uniform(-3.2, 3.2), rng.uniform(-9.5, 9.5), 0.01, row)
            assert 1.2 * row["v_min"] <= state[3] <= 1.2 * row["v_max"]


def test_internal_steps_follow_the_stiffness():
    row = small_row()
    counts = [drift_substeps(RK4, rolling(speed, row), 0.0, 0.01, row) for speed in (0.3, 1.0, 3.0, 20.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 1
    assert drift_substeps(EULER, rolling(3.0, row), 0.0, 0.01, row) > counts[2]
