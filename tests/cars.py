"""Cars for the tests of the dynamics: the CommonRoad package's, and ours as float64 parameter rows."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from outlap.simulator import vehicle as column
from outlap.simulator.dynamics import kinematic_speed, kinematic_values, rolling_wheel_speeds
from outlap.simulator.vehicle import PRESETS, PacejkaTyre, VehicleParams, parameter_bounds

SMALL_CAR = 0  # the package has no 1:10 car: its BMW with the F1TENTH car's numbers


@cache
def package_car(number: int) -> Any:
    """Parameters in the package's form: its cars 1 to 3, or SMALL_CAR."""
    if number != SMALL_CAR:
        return setup_vehicle_parameters(number)
    car: Any = copy.deepcopy(setup_vehicle_parameters(2))
    small: Any = VehicleParams()
    car.a, car.b, car.h_s, car.m, car.I_z = small.lf, small.lr, small.h, small.m, small.I
    car.R_w, car.I_y_w = small.wheel_radius, small.wheel_inertia
    car.T_sb, car.T_se = small.brake_split, small.engine_split
    car.tire.p_ky1 = -5.0 * car.tire.p_dy1  # about the small car's cornering stiffness
    car.steering.min, car.steering.max = small.steer_min, small.steer_max
    car.steering.v_min, car.steering.v_max = -small.steer_rate_max, small.steer_rate_max
    limits = car.longitudinal
    limits.v_min, limits.v_max, limits.v_switch, limits.a_max = -5.0, 20.0, small.v_switch, small.a_max
    return car


def row_of(car) -> np.ndarray:
    """The package's parameters as our row, in float64."""
    row = parameter_bounds(VehicleParams())[0].astype(np.float64)
    for name in PacejkaTyre.model_fields:
        row[getattr(column, name.upper())] = getattr(car.tire, name)
    row[column.MU] = car.tire.p_dy1
    row[[column.C_SF, column.C_SR]] = -car.tire.p_ky1 / car.tire.p_dy1
    row[[column.LF, column.LR, column.H, column.M, column.I]] = car.a, car.b, car.h_s, car.m, car.I_z
    row[[column.WHEEL_RADIUS, column.WHEEL_INERTIA]] = car.R_w, car.I_y_w
    row[[column.BRAKE_SPLIT, column.ENGINE_SPLIT]] = car.T_sb, car.T_se
    row[[column.STEER_MIN, column.STEER_MAX]] = car.steering.min, car.steering.max
    row[column.STEER_RATE_MAX] = car.steering.v_max
    limits = car.longitudinal
    row[[column.V_MIN, column.V_MAX, column.V_SWITCH]] = limits.v_min, limits.v_max, limits.v_switch
    row[column.A_MAX] = limits.a_max
    row[column.KINEMATIC_SPEED] = 0.1  # the package's switch
    return row


def small_row(dt: float = 0.01, **changes: float) -> np.ndarray:
    """The F1TENTH car, ready to drive."""
    row = parameter_bounds(PRESETS["f1tenth"].model_copy(update=changes))[0].astype(np.float64)
    row[column.KINEMATIC_SPEED] = kinematic_speed(row, dt)
    return row


def rolling(speed: float, row: np.ndarray, steer: float = 0.0) -> tuple[float, ...]:
    """A state at the origin whose wheels do not slip."""
    yaw_rate, slip = kinematic_values(steer, speed, row)
    front, rear = rolling_wheel_speeds(steer, speed, yaw_rate, slip, row)
    return 0.0, 0.0, steer, speed, 0.0, yaw_rate, slip, front, rear
