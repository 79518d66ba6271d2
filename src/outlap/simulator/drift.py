"""The single-track drift model: Pacejka tyres with combined slip, and wheels that spin or lock.

Source: M. Althoff and G. Würsching, CommonRoad: Vehicle Models, 2020, section 9. Around 0.2 m/s it blends
into the kinematic bicycle, as which it also reverses. Slips are those of a wheel that may move backwards, so
that a car that slides backwards loses energy; they are the published ones for a wheel that moves
forward at 0.1 m/s or more.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

from outlap.simulator.bicycle import (
    axle_loads,
    kinematic,
    lateral_rate,
    rolling_wheel_speeds,
    stability_bound,
)
from outlap.simulator.tyre import tyre_forces

BLEND_SPEED = 0.2  # [m/s] where the model is half kinematic
BLEND_WIDTH = 0.05  # [m/s]
SLOWEST_ROLLING = 0.1  # [m/s] smallest divisor of a slip
RELAXATION_TIME = 0.02  # [s] with which wheel speeds approach rolling at low speed
MAX_SUBSTEPS = 64


@njit(cache=True, error_model="numpy")
def drift(state, steer_rate, acceleration, p):
    """Time derivative of a state under the drift model, wheel speeds included."""
    _, _, steer, speed, yaw, yaw_rate, slip, wheel_front, wheel_rear = state
    wheel_front = max(wheel_front, 0.0)  # wheels never spin backwards
    wheel_rear = max(wheel_rear, 0.0)
    radius = 1.0 * p.wheel_radius
    mass = 1.0 * p.m

    # Velocities of the axles in the frames of their wheels.
    forward = speed * math.cos(slip)
    leftward = speed * math.sin(slip)
    front_leftward = leftward + yaw_rate * p.lf
    cos_steer = math.cos(steer)
    sin_steer = math.sin(steer)
    front_rolling = forward * cos_steer + front_leftward * sin_steer
    front_sliding = front_leftward * cos_steer - forward * sin_steer
    rear_sliding = leftward - yaw_rate * p.lr

    front_angle = 0.0
    rear_angle = 0.0
    if speed > SLOWEST_ROLLING:
        front_angle = math.atan2(front_sliding, abs(front_rolling))
        rear_angle = math.atan2(rear_sliding, abs(forward))
    front_slip = (front_rolling - radius * wheel_front) / max(abs(front_rolling), SLOWEST_ROLLING)
    rear_slip = (forward - radius * wheel_rear) / max(abs(forward), SLOWEST_ROLLING)

    front_load, rear_load = axle_loads(acceleration, p)
    front_x, front_y = tyre_forces(front_slip, front_angle, mass * front_load, p)
    rear_x, rear_y = tyre_forces(rear_slip, rear_angle, mass * rear_load, p)

    # Forces on the car in its own frame, and along and across its direction of travel.
    force_x = rear_x + front_x * cos_steer - front_y * sin_steer
    front_y_car = front_y * cos_steer + front_x * sin_steer
    force_y = rear_y + front_y_car
    cos_slip = math.cos(slip)
    sin_slip = math.sin(slip)
    speed_rate = (force_x * cos_slip + force_y * sin_slip) / mass
    yaw_acceleration = (p.lf * front_y_car - p.lr * rear_y) / p.I
    slip_rate = 0.0
    if speed > SLOWEST_ROLLING:
        slip_rate = (force_y * cos_slip - force_x * sin_slip) / (mass * speed) - yaw_rate

    torque = mass * radius * acceleration
    front_share = 1.0 * p.engine_split if acceleration > 0.0 else 1.0 * p.brake_split
    front_spin = (front_share * torque - radius * front_x) / p.wheel_inertia
    rear_spin = ((1.0 - front_share) * torque - radius * rear_x) / p.wheel_inertia
    if wheel_front <= 0.0:
        front_spin = max(front_spin, 0.0)
    if wheel_rear <= 0.0:
        rear_spin = max(rear_spin, 0.0)

    weight = drift_weight(speed)
    slow = 1.0 - weight
    rolled = kinematic(state, steer_rate, acceleration, p)
    return (
        speed * math.cos(slip + yaw),
        speed * math.sin(slip + yaw),
        steer_rate,
        weight * speed_rate + slow * acceleration,
        weight * yaw_rate + slow * rolled[4],
        weight * yaw_acceleration + slow * rolled[5],
        weight * slip_rate + slow * rolled[6],
        weight * front_spin + slow * (max(front_rolling, 0.0) / radius - wheel_front) / RELAXATION_TIME,
        weight * rear_spin + slow * (max(forward, 0.0) / radius - wheel_rear) / RELAXATION_TIME,
    )


@njit(cache=True, error_model="numpy")
def drift_weight(speed):
    """The share of the drift model in its blend with the kinematic one."""
    return 0.5 * (math.tanh((speed - BLEND_SPEED) / BLEND_WIDTH) + 1.0)


@njit(cache=True, error_model="numpy")
def drift_substeps(integrator, state, acceleration, dt, p):
    """How many steps keep the drift model's fastest mode in the integrator's region of stability."""
    _, _, steer, speed, _, yaw_rate, slip, _, _ = state
    if speed <= SLOWEST_ROLLING:
        return 1
    front_load, rear_load = axle_loads(acceleration, p)
    radius = 1.0 * p.wheel_radius
    front_wheel, rear_wheel = rolling_wheel_speeds(steer, speed, yaw_rate, slip, p)
    stiffness = radius * radius * p.p_kx1 * p.m / p.wheel_inertia
    rate = max(
        stiffness * front_load / max(abs(front_wheel * radius), SLOWEST_ROLLING),
        stiffness * rear_load / max(abs(rear_wheel * radius), SLOWEST_ROLLING),
    )
    rate = max(rate, lateral_rate(-p.p_ky1 * front_load, -p.p_ky1 * rear_load, p) / speed)
    needed = math.ceil(drift_weight(speed) * rate * dt / stability_bound(integrator))
    return int(min(max(needed, 1.0), 1.0 * MAX_SUBSTEPS))
