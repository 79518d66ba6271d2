"""Limits against the CommonRoad package; controllers, lag and delay against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vehiclemodels.utils.acceleration_constraints import acceleration_constraints
from vehiclemodels.utils.steering_constraints import steering_constraints

from cars import package_car, precise, row_of, single, small_row
from outlap.simulator.actuators import (
    acceleration,
    delay_steps,
    lag,
    limit_acceleration,
    limit_force,
    limit_steering_rate,
    motor_force,
    ramp,
    steering_rate,
)
from outlap.simulator.state import SPEED, STEER, Y
from outlap.simulator.vehicle import ActuatorParams, VehicleParams, parameter_bounds
from synthetic_tracks import CAR, place, yard

cars = st.sampled_from([0, 1, 2, 3])
compiles = settings(deadline=None)


def row_with(**actuators: float) -> np.void:
    return precise(parameter_bounds(VehicleParams(), ActuatorParams(**actuators))[0])


@compiles
@given(cars, st.floats(-1.2, 1.2), st.floats(-10, 10))
def test_steering_rate_limits_are_the_packages(number, angle, rate):
    car = package_car(number)
    row = row_of(car)
    for steer in (angle, car.steering.min, car.steering.max):
        assert limit_steering_rate(rate, steer, row) == steering_constraints(steer, rate, car.steering)


@compiles
@given(cars, st.floats(-1.2, 1.2), st.floats(-30, 30))
def test_acceleration_limits_are_the_packages(number, fraction, push):
    car = package_car(number)
    row, limits = row_of(car), car.longitudinal
    for speed in (fraction * limits.v_max, limits.v_min, limits.v_max, limits.v_switch, 0.0):
        expected = acceleration_constraints(speed, push, limits)
        assert limit_acceleration(push, speed, row) == pytest.approx(expected, rel=1e-12)


@compiles
@given(st.floats(-1, 1), st.floats(-0.4189, 0.4189), st.floats(0.5, 1e7), st.floats(0.001, 0.05))
def test_steering_never_passes_its_target_nor_a_stop(target, steer, gain, dt):
    row = row_with()
    row["steer_gain"] = gain
    reachable = min(max(target, row["steer_min"]), row["steer_max"])
    rate = steering_rate(target, steer, dt, row)
    assert abs(rate) <= row["steer_rate_max"]
    after = steer + rate * dt
    assert abs(reachable - after) <= abs(reachable - steer) + 1e-12
    assert (reachable - steer) * (reachable - after) >= -1e-12
    assert row["steer_min"] - 1e-12 <= after <= row["steer_max"] + 1e-12


def test_bang_bang_steering_takes_the_full_rate_and_lands_on_the_target():
    row, steer, dt = row_with(), 0.0, 0.01
    angles = []
    for _ in range(12):
        steer += steering_rate(0.3, steer, dt, row) * dt
        angles.append(steer)
    ramp = np.minimum(np.arange(1, 13) * 3.2 * dt, 0.3)
    np.testing.assert_allclose(angles, ramp, atol=1e-6)
    assert steering_rate(0.3, angles[-1], dt, row) == pytest.approx(0.0, abs=1e-9)


def test_proportional_steering_approaches_geometrically():
    row, steer, dt = row_with(steer_gain=5.0), 0.0, 0.01
    for _ in range(20):
        steer += steering_rate(0.1, steer, dt, row) * dt
    assert steer == pytest.approx(0.1 * (1 - (1 - 5.0 * dt) ** 20))


@pytest.mark.parametrize(
    ("speed", "target", "expected"),
    [
        (5.0, 5.5, 10 * 9.51 / 20 * 0.5),  # forward, faster
        (5.0, 4.9, -10 * 9.51 / 5 * 0.1),  # forward, slower
        (-2.0, -1.0, 2 * 9.51 / 20 * 1.0),  # reverse, braking
        (-2.0, -2.5, -2 * 9.51 / 5 * 0.5),  # reverse, faster
        (0.0, 2.0, 2 * 9.51 / 20 * 2.0),  # at rest counts as reverse
    ],
)
def test_speed_controller_has_the_gyms_four_gains(speed, target, expected):
    assert acceleration(target, speed, row_with()) == pytest.approx(expected, rel=1e-6)


def test_a_car_that_can_neither_drive_nor_reverse_stands():
    row = row_with()
    row["v_min"] = row["v_max"] = 0.0
    assert [acceleration(target, 0.0, row) for target in (-1.0, 0.0, 1.0)] == [0.0, 0.0, 0.0]


def test_a_car_without_reverse_stops_smoothly():
    row = row_with()
    row["v_min"] = 0.0
    speed = 3.0
    for _ in range(500):
        before = speed
        speed += acceleration(0.0, speed, row) * 0.01
        assert 0.0 <= speed <= before
    assert speed < 1e-3


@compiles
@given(st.floats(-5, 20), st.floats(-5, 20))
def test_speed_never_leaves_its_limits(speed, target):
    row = row_with()
    for _ in range(50):
        speed += acceleration(target, speed, row) * 0.01
        assert row["v_min"] - 1e-9 <= speed <= row["v_max"] + 1e-9


def test_engine_power_limits_acceleration_above_the_switching_speed():
    row = row_with()
    power = row["a_max"] * row["v_switch"]
    for speed in (8.0, 12.0, 19.0):
        assert limit_acceleration(100.0, speed, row) * speed == pytest.approx(power)
    assert limit_acceleration(-100.0, 19.0, row) == -row["a_max"]


@compiles
@given(st.floats(0.001, 1.0), st.floats(0.001, 0.1), st.integers(1, 50))
def test_lag_is_the_exact_step_response(time_constant, dt, steps):
    value = 0.0
    for _ in range(steps):
        value = lag(value, 1.0, dt, time_constant)
    assert value == pytest.approx(1 - math.exp(-steps * dt / time_constant), rel=1e-9)


def test_no_lag_passes_the_command():
    assert lag(0.2, 0.7, 0.01, 0.0) == 0.7


@pytest.mark.parametrize(("delay", "steps"), [(0.0, 0), (0.004, 0), (0.006, 1), (0.01, 1), (0.07, 7), (0.1, 10)])
def test_delays_are_whole_steps(delay, steps):
    row = row_with(steer_delay=delay, speed_delay=2 * delay)
    assert delay_steps(row, 0.01) == (steps, round(2 * delay / 0.01))


def test_scalar_functions_read_float32_records_too():
    row = single(small_row())
    assert steering_rate(0.3, 0.1, 0.01, row) == pytest.approx(3.2, rel=1e-6)
    assert acceleration(20.0, 5.0, row) == pytest.approx(9.51, rel=1e-6)


# Motors and brakes as forces


@pytest.mark.parametrize(
    ("speed", "target", "force"),
    [
        (2.0, 2.5, 6.7 * 0.5),  # proportional to the error, whatever the mass
        (2.0, 1.0, -6.7),
        (2.0, 20.0, 30.0),  # the motor's largest
        (2.0, -20.0, -50.0),  # the brakes'
        (10.0, 20.0, 20.0),  # 200 W / 10 m/s
        (-2.0, -20.0, -30.0),  # in reverse the motor drives backwards,
        (-2.0, 20.0, 50.0),  # and the brakes push forward
        (0.0, 20.0, 30.0),
        (20.0, 25.0, 0.0),  # at the top speed
        (-5.0, -9.0, 0.0),
    ],
)
def test_motor_and_brakes_give_forces_within_their_limits(speed, target, force):
    row = row_with()
    row["motor_force"], row["motor_power"], row["brake_force"] = 30.0, 200.0, 50.0
    for mass in (2.0, 5.0):
        row["m"] = mass
        assert motor_force(target, speed, row) == pytest.approx(force, rel=1e-6)


@compiles
@given(st.floats(-6, 21), st.floats(-1e6, 1e6))
def test_a_motor_never_gives_more_than_its_power(speed, force):
    row = row_with()
    given_force = limit_force(force, speed, row)
    assert given_force * speed <= row["motor_power"] * (1 + 1e-9)
    assert abs(given_force) <= max(row["motor_force"], row["brake_force"])


def test_a_ramp_limits_how_fast_the_commanded_speed_changes():
    row = row_with(speed_ramp_up=2.0, speed_ramp_down=5.0)
    assert ramp(1.0, 8.0, 0.01, row) == pytest.approx(1.02)
    assert ramp(1.0, 1.01, 0.01, row) == pytest.approx(1.01)
    assert ramp(1.0, -3.0, 0.01, row) == pytest.approx(0.95)
    assert ramp(1.0, -3.0, 0.01, row_with()) == -3.0
    assert ramp(1.0, 8.0, 0.01, row_with(speed_ramp_down=5.0)) == 8.0


def driven(command: str, model: str, commands: list[tuple[float, float]], speed: float = 3.0, **changes: float):
    """The speed and the steering angle of a car after each command: (steps, 2)."""
    params = np.full((1, 1), CAR)
    for name, value in changes.items():
        params[name] = value
    options: dict[str, Any] = {"command": command, "model": model}
    sim = place(yard(40.0), np.zeros((1, 1, 3)), speed=speed, params=params, beams=0, **options)
    seen = []
    for each in commands:
        sim.step(np.array([[each]]))
        seen.append(sim.worlds.state[0, 0, [SPEED, STEER]])
    return np.array(seen)


def test_trim_and_ratio_shift_and_scale_the_steering_angle():
    turned = driven("speed", "kinematic", [(0.1, 3.0)] * 30, steer_trim=-0.02, steer_ratio=1.1)
    assert turned[-1, 1] == pytest.approx(0.1 * 1.1 - 0.02, abs=1e-6)
    straight = driven("speed", "kinematic", [(0.0, 3.0)] * 30, steer_trim=0.05)
    assert straight[-1, 1] == pytest.approx(0.05, abs=1e-6)
    stopped = driven("speed", "kinematic", [(0.4, 3.0)] * 30, steer_trim=0.2)
    assert stopped[-1, 1] == pytest.approx(0.4189, abs=1e-6)


@pytest.mark.parametrize("model", ["single_track", "nonlinear_single_track"])
@pytest.mark.parametrize("share", [0.5, -0.25])
def test_a_command_by_acceleration_is_a_share_of_the_largest_force(model, share):
    speeds = driven("acceleration", model, [(0.0, share)] * 20)[:, 0]
    force = CAR["motor_force"] if share > 0 else CAR["brake_force"]
    largest = CAR["a_max"] if model == "single_track" else force / CAR["m"]
    assert speeds[-1] - 3.0 == pytest.approx(share * largest * 0.2, rel=1e-3)


@pytest.mark.parametrize("model", ["kinematic", "single_track", "nonlinear_single_track"])
def test_brakes_stop_a_car_and_do_not_reverse_it(model):
    speeds = driven("acceleration", model, [(0.0, -1.0)] * 150)[:, 0]
    assert speeds[0] < 3.0
    assert np.all(np.abs(speeds[-50:]) < 0.1)
    assert np.ptp(speeds[-50:]) == 0.0
    again = driven("acceleration", model, [(0.0, -1.0)] * 100 + [(0.0, 0.5)] * 30)[:, 0]
    assert again[-1] > 1.0


def test_a_heavier_car_gains_less_speed_from_the_same_commands():
    """Twice the mass, half the gain: of the motor's force, and of the speed controller's."""
    for command, second in (("acceleration", 0.3), ("speed", 4.0)):
        light, heavy = (
            driven(command, "nonlinear_single_track", [(0.0, second)] * 10, m=mass)[-1, 0] - 3.0 for mass in (2.5, 5.0)
        )
        assert light / heavy == pytest.approx(2.0, rel=0.15 if command == "speed" else 1e-3)


def test_anti_lock_brakes_leave_grip_for_steering():
    """Full brakes in a bend: locked wheels slide straight on, with a share of the grip left the car turns."""
    turned = []
    for share in (1.0, 0.8):
        params = np.full((1, 1), CAR)
        params["grip_share"], params["brake_force"] = share, 80.0
        sim = place(
            yard(40.0), np.zeros((1, 1, 3)), speed=6.0, params=params, beams=0, model="nonlinear_single_track",
            command="acceleration",
        )  # fmt: skip
        for _ in range(40):
            sim.step(np.array([[[0.25, -1.0]]]))
        turned.append(sim.worlds.state[0, 0, Y])
    assert turned[1] > 2.0 * turned[0] + 0.05
