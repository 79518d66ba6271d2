"""The models against the CommonRoad package, closed forms and conserved quantities.

The scalar functions are called with float64 records here, so that derivatives can be compared to 1e-9.
"""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.integrate import solve_ivp
from vehiclemodels.utils.vehicle_dynamics_ks_cog import vehicle_dynamics_ks_cog
from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

from cars import SMALL_CAR, package_car, precise, rolling, row_of, single, small_row
from outlap.simulator.actuators import acceleration, limit_acceleration, limit_steering_rate, steering_rate
from outlap.simulator.bicycle import axle_loads
from outlap.simulator.dynamics import (
    DRIFT,
    EULER,
    KINEMATIC,
    RK4,
    SINGLE_TRACK,
    drift,
    integrate,
    kinematic,
    kinematic_speed,
    kinematic_values,
    rolling_wheel_speeds,
    single_track,
    wrap_angle,
)
from outlap.simulator.vehicle import N_PARAMS

compiles = settings(deadline=None)  # in the first example: how long one takes says nothing
unit = st.floats(-1.0, 1.0, allow_subnormal=False)
share = st.floats(0.0, 1.0, allow_subnormal=False)
cars = st.sampled_from([SMALL_CAR, 1, 2, 3])


# --- derivatives against the package ---------------------------------------------------------------------


@compiles
@given(cars, unit, share, unit, unit, unit)
def test_kinematic_derivative_is_the_packages(number, steer, speed, yaw, rate, push):
    car = package_car(number)
    row = row_of(car)
    steer *= 0.4
    speed = row["v_min"] + speed * (row["v_max"] - row["v_min"])
    rate = limit_steering_rate(rate * 5.0, steer, row)
    push = limit_acceleration(push * 20.0, speed, row)
    ours = kinematic((1.0, 2.0, steer, speed, yaw * math.pi, 0.0, 0.0, 0.0, 0.0), rate, push, row)
    theirs = vehicle_dynamics_ks_cog([1.0, 2.0, steer, speed, yaw * math.pi], [rate, push], car)
    np.testing.assert_allclose(ours[:5], theirs, rtol=1e-9, atol=1e-9)


@compiles
@given(unit, unit, unit, unit)
def test_kinematic_rates_are_the_derivatives_of_the_kinematic_values(steer, speed, rate, push):
    # Central differences. The package's slip rate is no oracle here: it has tan^4 where tan^2 is right.
    row, steer, speed, rate, push = small_row(), steer * 0.4, speed * 5, rate * 3, push * 9
    ours = kinematic((0.0, 0.0, steer, speed, 0.0, 0.0, 0.0, 0.0, 0.0), rate, push, row)
    e = 1e-5
    after = np.array(kinematic_values(steer + e * rate, speed + e * push, row))
    before = np.array(kinematic_values(steer - e * rate, speed - e * push, row))
    np.testing.assert_allclose(ours[5:7], (after - before) / (2 * e), rtol=1e-6, atol=1e-6)


@compiles
@given(cars, unit, share, unit, unit, unit, unit, unit)
def test_single_track_derivative_is_the_packages(number, steer, speed, yaw, yaw_rate, slip, rate, push):
    car = package_car(number)
    row = row_of(car)
    speed = 0.1 + speed * (row["v_max"] - 0.1)
    x = [1.0, 2.0, steer * 0.4, speed, yaw * math.pi, yaw_rate * 5, slip]
    rate = limit_steering_rate(rate * 5.0, x[2], row)
    push = limit_acceleration(push * 20.0, speed, row)
    theirs = vehicle_dynamics_st(list(x), [rate, push], car)
    ours = single_track((*x, 0.0, 0.0), rate, push, row)
    np.testing.assert_allclose(ours[:7], theirs, rtol=1e-9, atol=1e-9 * (1 + 1 / speed**2))


@compiles
@given(cars, unit, unit)
def test_single_track_is_kinematic_at_low_speed_in_both_directions(number, steer, speed):
    row = row_of(package_car(number))
    state = (0.0, 0.0, steer * 0.4, speed * 0.099, 0.3, 7.0, 1.0, 0.0, 0.0)
    assert single_track(state, 0.5, -1.0, row) == kinematic(state, 0.5, -1.0, row)


@compiles
@given(cars, unit, share, unit, unit, unit, unit, unit, st.floats(0.0, 2.0), st.floats(0.0, 2.0))
def test_drift_derivative_is_the_packages(number, steer, speed, yaw, yaw_rate, slip, rate, push, spin_front, spin_rear):
    car = package_car(number)
    row = row_of(car)
    speed = 1.0 + speed * (row["v_max"] - 1.0)
    x = [1.0, 2.0, steer * 0.4, speed, yaw * math.pi, yaw_rate * 3, slip * 1.2]
    x += [(0.001 + spin_front) * speed / row["wheel_radius"]]
    x += [(0.001 + spin_rear) * speed / row["wheel_radius"]]
    # Below 0.1 m/s of rolling our slip is another, for wheels that move backwards.
    front, rear = rolling_wheel_speeds(x[2], x[3], x[5], x[6], row)
    assume(min(front, rear) * row["wheel_radius"] > 0.1)
    rate = limit_steering_rate(rate * 5.0, x[2], row)
    push = limit_acceleration(push * 9.0, speed, row)
    theirs = vehicle_dynamics_std(list(x), [rate, push], car)
    ours = drift(tuple(x), rate, push, row)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-8)


@compiles
@given(cars, unit, st.floats(0.12, 1.0), unit, st.floats(0.5, 1.5))
def test_drift_blends_into_the_kinematic_model_as_the_package_does(number, steer, speed, push, spin):
    # Without a steering rate and at the kinematic slip angle, where our kinematic slip rate is the package's.
    car = package_car(number)
    row = row_of(car)
    x = list(rolling(speed, row, steer * 0.4))
    x[7] *= spin
    assume(x[7] / spin * row["wheel_radius"] > 0.1)
    assume(x[8] * row["wheel_radius"] > 0.1)
    theirs = vehicle_dynamics_std(list(x), [0.0, push * 9.0], car)
    np.testing.assert_allclose(drift(tuple(x), 0.0, push * 9.0, row), theirs, rtol=1e-9, atol=1e-8)


# --- five seconds of driving against an accurate solution of the package's equations -----------------------

Manoeuvre = list[tuple[float, float, float]]  # (duration [s], steering rate [rad/s], acceleration [m/s^2])
STEP_STEER: Manoeuvre = [(0.5, 0, 0), (0.1, 1.5, 0), (1.9, 0, 0), (0.2, -1.5, 0), (2.3, 0, 0)]
BRAKE_IN_TURN: Manoeuvre = [
    (0.1, 1.0, 0),
    (0.9, 0, 0),
    (0.5, 0, -2),
    (1.5, 0, 1),
    (0.1, -1.0, 0),
    (1.9, 0, 2),
]
REVERSE: Manoeuvre = [(0.4, 0, -4), (0.2, 1.5, 0), (2.4, 0, 0), (0.5, -1.2, 1), (1.5, 0, -1)]
POWER_SLIDE: Manoeuvre = [
    (0.1, 1.0, 0),
    (0.4, 0, 0),
    (0.3, 0, 6),
    (0.15, -3.1, 0),
    (0.5, 0, 0),
    (0.15, 2.0, 0),
    (3.4, 0, 1),
]


def drive(model, integrator, state, manoeuvre: Manoeuvre, dt, row):
    for duration, rate, push in manoeuvre:
        for _ in range(round(duration / dt)):
            state = integrate(model, integrator, state, float(rate), float(push), dt, row)
    return np.array(state)


def solve(rates, state, manoeuvre: Manoeuvre):
    """`rates(x, u)` integrated by LSODA over each piece of constant inputs."""
    x = np.array(state)
    for duration, rate, push in manoeuvre:
        u = [float(rate), float(push)]
        x = solve_ivp(lambda _, x, u=u: rates(list(x), u), (0, duration), x, "LSODA", rtol=1e-9, atol=1e-9).y[:, -1]
    return x


def same_end(ours, theirs, position, angle):
    """Positions to `position` [m], speed to the same [m/s], angles and yaw rate to `angle` [rad, rad/s]."""
    difference = np.array(ours[: len(theirs)]) - theirs
    difference[4] = wrap_angle(difference[4])
    limits = [position, position, angle, position, angle, 10 * angle, angle, 1.0, 1.0]
    assert np.all(np.abs(difference) <= limits[: len(theirs)]), difference


@pytest.mark.parametrize(("dt", "position", "angle"), [(0.01, 1e-3, 1e-4), (0.001, 1e-6, 1e-6)])
@pytest.mark.parametrize("manoeuvre", [STEP_STEER, BRAKE_IN_TURN])
def test_single_track_drives_as_the_packages(manoeuvre, dt, position, angle):
    car = package_car(SMALL_CAR)
    row = row_of(car)
    state = rolling(6.0, row)
    theirs = solve(lambda x, u: vehicle_dynamics_st(x, u, car), state[:7], manoeuvre)
    same_end(drive(SINGLE_TRACK, RK4, state, manoeuvre, dt, row), theirs, position, angle)


@pytest.mark.parametrize("manoeuvre", [REVERSE, BRAKE_IN_TURN])
def test_kinematic_drives_as_the_packages(manoeuvre):
    car = package_car(SMALL_CAR)
    row = row_of(car)
    state = rolling(0.0, row)
    theirs = solve(lambda x, u: vehicle_dynamics_ks_cog(x, u, car), state[:5], manoeuvre)
    same_end(drive(KINEMATIC, RK4, state, manoeuvre, 0.01, row), theirs, 1e-6, 1e-6)


def force_balance(x, u, row):
    """A single track from Newton's laws, with tyre forces that oppose the axles' sideways motion."""
    _, _, steer, speed, yaw, yaw_rate, slip = x
    front_load, rear_load = axle_loads(u[1], row)
    sideways = speed * slip
    front = row["mu"] * row["C_Sf"] * front_load * row["m"]
    front *= -(sideways + row["lf"] * yaw_rate - speed * steer) / abs(speed)
    rear = row["mu"] * row["C_Sr"] * rear_load * row["m"]
    rear *= -(sideways - row["lr"] * yaw_rate) / abs(speed)
    return [
        speed * math.cos(yaw + slip),
        speed * math.sin(yaw + slip),
        *u,
        yaw_rate,
        (row["lf"] * front - row["lr"] * rear) / row["I"],
        ((front + rear) / row["m"] - yaw_rate * speed) / speed,
    ]


@pytest.mark.parametrize("speed", [4.0, -4.0])
def test_single_track_obeys_newton_in_both_directions(speed):
    # The package's single track diverges in reverse: its tyre forces then push the way the car slides.
    row = small_row()
    state = rolling(speed, row)
    manoeuvre = [(0.2, 1.0, 0.0), (1.8, 0.0, 0.0), (1.0, -0.3, 0.5), (2.0, 0.0, -0.5)]
    theirs = solve(lambda x, u: force_balance(x, u, row), state[:7], manoeuvre)
    same_end(drive(SINGLE_TRACK, RK4, state, manoeuvre, 0.01, row), theirs, 1e-3, 1e-4)


@pytest.mark.parametrize(("dt", "position", "angle"), [(0.01, 2e-2, 5e-3), (0.001, 1e-4, 1e-5)])
@pytest.mark.parametrize("manoeuvre", [STEP_STEER, BRAKE_IN_TURN, POWER_SLIDE])
def test_drift_drives_as_the_packages(manoeuvre, dt, position, angle):
    car = package_car(SMALL_CAR)
    if manoeuvre is POWER_SLIDE:
        car = copy.deepcopy(car)
        car.T_se = 0.0  # the rear wheels alone drive
    row = row_of(car)
    state = rolling(6.0, row)
    theirs = solve(lambda x, u: vehicle_dynamics_std(x, u, car), state, manoeuvre)
    same_end(drive(DRIFT, RK4, state, manoeuvre, dt, row), theirs, position, angle)


# --- the integrators -------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [KINEMATIC, SINGLE_TRACK, DRIFT])
@pytest.mark.parametrize(("integrator", "order"), [(EULER, 1), (RK4, 4)])
def test_convergence_order(model, integrator, order):
    row = small_row()
    row["p_ky1"], row["p_kx1"] = -5.0, 5.0  # soft tyres: drift then takes no internal steps
    row["wheel_inertia"] = 0.01
    turn: Manoeuvre = [(0.32, 0.8, 1.0)]
    start = rolling(6.0, row)
    exact = drive(model, RK4, start, turn, 0.00025, row)
    coarse, fine = (np.abs(drive(model, integrator, start, turn, dt, row) - exact)[:7] for dt in (0.02, 0.01))
    measured = np.log2(np.max(coarse) / np.max(fine))
    assert measured == pytest.approx(order, abs=0.25)


@compiles
@given(st.sampled_from([KINEMATIC, SINGLE_TRACK]), st.sampled_from([EULER, RK4]), unit, share, unit, unit, unit)
def test_a_mirrored_car_drives_the_mirrored_path(model, integrator, steer, speed, yaw_rate, rate, push):
    row = small_row()
    mirror = np.array([1, -1, -1, 1, -1, -1, -1, 1, 1])
    state = (0.0, 0.0, steer * 0.4, 8 * speed - 2, 0.0, yaw_rate, 0.0, 0.0, 0.0)
    manoeuvre: Manoeuvre = [(0.1, rate, push * 5), (0.2, -rate, 0)]
    mirrored: Manoeuvre = [(0.1, -rate, push * 5), (0.2, rate, 0)]
    left = drive(model, integrator, state, manoeuvre, 0.01, row)
    right = drive(model, integrator, tuple(mirror * state), mirrored, 0.01, row)
    np.testing.assert_allclose(right, mirror * left, rtol=1e-12, atol=1e-12)


@compiles
@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_are_in_the_half_open_interval(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)
    assert math.sin(wrapped - angle) == pytest.approx(0.0, abs=1e-8)


def test_yaw_stays_wrapped_over_many_turns():
    row, state = small_row(), rolling(3.0, small_row(), 0.4)
    turned = 0.0
    for _ in range(1000):
        before = state[4]
        state = integrate(SINGLE_TRACK, RK4, state, 0.0, 0.0, 0.01, row)
        turned += wrap_angle(state[4] - before)
        assert -math.pi < state[4] <= math.pi
    assert turned > 6 * math.pi


# --- any car, any driver -----------------------------------------------------------------------------------


@njit(error_model="numpy")
def drive_at_random(model, integrator, commands, hold, dt, row):
    """The largest magnitude of each state column over a drive; every command is held for `hold` steps."""
    radius = row["wheel_radius"]
    state = (0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0 / radius, 2.0 / radius)
    largest = np.zeros(9)
    for k in range(len(commands) * hold):
        target_steer, target_speed = commands[k // hold]
        rate = steering_rate(target_steer, state[2], dt, row)
        push = acceleration(target_speed, state[3], row)
        state = integrate(model, integrator, state, rate, push, dt, row)
        for i, value in enumerate(state):
            if not abs(value) <= largest[i]:  # NaN gets in, too
                largest[i] = abs(value)
    return largest


@pytest.mark.parametrize("model", [KINEMATIC, SINGLE_TRACK, DRIFT])
@pytest.mark.parametrize(("integrator", "dt"), [(RK4, 0.01), (EULER, 0.01), (RK4, 0.04)])
def test_random_cars_driven_at_random_stay_finite_and_bounded(model, integrator, dt):
    rng = np.random.default_rng(7)
    base = small_row()
    for _ in range(40 if model != DRIFT else 10):
        row = precise(rng.uniform(0.7, 1.3, N_PARAMS) * np.array(list(base.item())))
        row["mu"] = rng.uniform(0.3, 1.2)
        row["steer_gain"] = 1e6
        row["brake_split"], row["engine_split"] = rng.uniform(0, 1, 2)
        row["kinematic_speed"] = kinematic_speed(row, dt, integrator)
        commands = rng.uniform([-0.5, row["v_min"]], [0.5, row["v_max"]], (50, 2))
        largest = drive_at_random(model, integrator, commands, round(0.2 / dt), dt, single(row))
        assert np.all(np.isfinite(largest)), (row, largest)
        steer_limit = max(-row["steer_min"], row["steer_max"])
        speed_limit = row["v_max"] + row["a_max"] * dt
        assert largest[2] <= steer_limit * (1 + 1e-6)
        assert largest[3] <= speed_limit
        assert np.all(largest[:2] <= 10 * speed_limit)
        assert largest[4] <= math.pi
        if model == KINEMATIC:
            fastest_turn = abs(kinematic_values(largest[2], largest[3], row)[0])
            assert largest[5] <= fastest_turn * (1 + 1e-6)
        else:
            assert largest[5] <= 50
        assert largest[6] <= math.pi / (1 if model == DRIFT else 2)
        assert np.all(largest[7:] <= 1.2 * speed_limit / row["wheel_radius"])
