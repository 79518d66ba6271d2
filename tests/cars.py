"""Cars for the tests of the dynamics: the CommonRoad package's, and ours as records of float64 parameters."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from outlap.simulator.dynamics import kinematic_speed, kinematic_values, rolling_wheel_speeds
from outlap.simulator.vehicle import NAMES, PRESETS, PacejkaTyre, VehicleParams, parameter_bounds, to_records

PRECISE = np.dtype([(name, np.float64) for name in NAMES])
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


def precise(values: np.ndarray) -> np.void:
    """Parameters (N_PARAMS,) as a record of float64."""
    return values.astype(np.float64).view(PRECISE)[0]


def single(row: np.void) -> np.void:
    """A record of float64 as the simulator's."""
    record: Any = to_records(np.array(list(row.item())))[()]
    return record


def row_of(car) -> np.void:
    """The package's parameters as our record, in float64."""
    row = precise(parameter_bounds(VehicleParams())[0])
    for name in PacejkaTyre.model_fields:
        row[name] = getattr(car.tire, name)
    row["mu"] = car.tire.p_dy1
    row["C_Sf"] = row["C_Sr"] = -car.tire.p_ky1 / car.tire.p_dy1
    row["lf"], row["lr"], row["h"], row["m"], row["I"] = car.a, car.b, car.h_s, car.m, car.I_z
    row["wheel_radius"], row["wheel_inertia"] = car.R_w, car.I_y_w
    row["brake_split"], row["engine_split"] = car.T_sb, car.T_se
    row["steer_min"], row["steer_max"] = car.steering.min, car.steering.max
    row["steer_rate_max"] = car.steering.v_max
    limits = car.longitudinal
    row["v_min"], row["v_max"], row["v_switch"] = limits.v_min, limits.v_max, limits.v_switch
    row["a_max"] = limits.a_max
    row["kinematic_speed"] = 0.1  # the package's switch
    return row


def small_row(dt: float = 0.01, **changes: float) -> np.void:
    """The F1TENTH car, ready to drive."""
    row = precise(parameter_bounds(PRESETS["f1tenth"].model_copy(update=changes))[0])
    row["kinematic_speed"] = kinematic_speed(row, dt)
    return row


def rolling(speed: float, row: np.void, steer: float = 0.0) -> tuple[float, ...]:
    """A state at the origin whose wheels do not slip."""
    yaw_rate, slip = kinematic_values(steer, speed, row)
    front, rear = rolling_wheel_speeds(steer, speed, yaw_rate, slip, row)
    return 0.0, 0.0, steer, speed, 0.0, yaw_rate, slip, front, rear
