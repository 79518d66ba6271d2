"""What a planned line may ask of a car."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from outlap.errors import OutlapError
from outlap.simulator.bicycle import GRAVITY
from outlap.simulator.vehicle import NAMES, VehicleParams, parameter_bounds, to_records
from outlap.track.raceline import Raceline

LEAST = 0.01  # of what a line that never turns, or never changes its speed, asks for


@dataclass(frozen=True)
class CarLimits:
    """A car as a planner sees it: a point with a friction ellipse, a motor, a steering lock and a rectangle for a body.

    The ellipse is (a_x / A_x)² + (a_y / A_y)² ≤ 1 with A_y = mu g across, and along the smaller of mu g and what motor
    or brakes give.
    """

    mu: float  # tyre-road friction [-]
    a_max: float  # with which the motor accelerates [m/s²]
    a_brake: float  # [m/s²]
    v_max: float  # [m/s]
    v_switch: float  # above it, power limits acceleration to a_max v_switch / v [m/s]
    max_curvature: float  # of the tightest arc at full lock [1/m]
    steer_rate_max: float  # [rad/s]
    wheelbase: float  # [m]
    length: float  # of the body [m]
    width: float  # [m]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0.0):
                raise OutlapError(f"limits: {field.name} is {value}; it must be a positive number")

    @property
    def grip(self) -> float:
        """The acceleration across that friction allows [m/s²]."""
        return self.mu * GRAVITY

    @classmethod
    def of_record(cls, record: np.ndarray, model: str) -> CarLimits:
        """Return the limits of a car under a vehicle model.

        Args:
            record: of `simulator.vehicle.PARAMETERS`.
            model: see `grip_and_motor`.
        """
        values = {name: float(record[name]) for name in NAMES}
        wheelbase = values["lf"] + values["lr"]
        lock = min(values["steer_max"], -values["steer_min"])
        values |= {"max_curvature": math.tan(lock) / wheelbase, "wheelbase": wheelbase}
        values |= {name: float(value) for name, value in grip_and_motor(record, model).items()}
        values = {field.name: values[field.name] for field in fields(cls)}
        return cls(**{name: float(f"{value:.6g}") for name, value in values.items()})

    def implied_by(self, line: Raceline) -> CarLimits:
        """What a raceline with speeds asks of a car: its extremes of speed and acceleration, and this car's body."""
        return replace(
            self,
            mu=max(float(np.max(line.speed**2 * np.abs(line.curvature))) / GRAVITY, LEAST),
            a_max=max(float(line.acceleration.max()), LEAST),
            a_brake=max(-float(line.acceleration.min()), LEAST),
            v_max=float(line.speed.max()),
            v_switch=float(line.speed.max()),
        )

    @classmethod
    def of(cls, params: VehicleParams, model: str = "single_track") -> CarLimits:
        """Return the limits of a car, or of the middle of every range, under a vehicle model."""
        return cls.of_record(to_records(np.mean(parameter_bounds(params), axis=0)), model)


def grip_and_motor(params: np.ndarray, model: str) -> dict[str, np.ndarray]:
    """Return the limits of cars that depend on the vehicle model: `mu`, `a_max`, `a_brake` and `v_switch`, (...) each.

    Args:
        params: records of `simulator.vehicle.PARAMETERS`, (...).
        model: of `SimulatorConfig`. Under `nonlinear_single_track`, accelerations follow from forces and mass, and the
            axle with less friction limits the grip.
    """
    names = ("mu", "a_max", "v_switch", "front_peak", "rear_peak", "motor_force", "brake_force", "motor_power", "m")
    value = {name: np.asarray(params[name], np.float64) for name in names}
    if model != "nonlinear_single_track":
        return {"mu": value["mu"], "a_max": value["a_max"], "a_brake": value["a_max"], "v_switch": value["v_switch"]}
    return {
        "mu": value["mu"] * np.minimum(value["front_peak"], value["rear_peak"]),
        "a_max": value["motor_force"] / value["m"],
        "a_brake": value["brake_force"] / value["m"],
        "v_switch": value["motor_power"] / value["motor_force"],
    }
