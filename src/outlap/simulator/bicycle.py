"""The bicycle model: kinematic, and as a single track with linear tyres.

Source: M. Althoff and G. Würsching, CommonRoad: Vehicle Models, 2020, sections 5 and 7; reference point:
centre of gravity. Where this departs from the published equations, on purpose:

- The tyre forces change sign with the direction of travel. The published ones do not, which makes any
  reversing car diverge.
- The kinematic slip rate is the derivative of the kinematic slip angle; the published one squares a tangent
  too often.
- An axle's load never falls below zero.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

EULER, RK4 = 0, 1

GRAVITY = 9.81  # [m/s^2]
LOWEST_KINEMATIC_SPEED = 0.1  # [m/s] the single-track divides by speed; the published switch


@njit(cache=True, error_model="numpy")
def kinematic(state, steer_rate, acceleration, p):
    """Time derivative of a state under the kinematic model; wheel speeds have none."""
    _, _, steer, speed, yaw, _, _, _, _ = state
    wheelbase = 1.0 * p.lf + p.lr
    tan_steer = math.tan(steer)
    tan_slip = tan_steer * p.lr / wheelbase
    cos_slip = 1.0 / math.sqrt(1.0 + tan_slip * tan_slip)
    sin_slip = tan_slip * cos_slip
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    tan_rate = steer_rate * (1.0 + tan_steer * tan_steer)  # d tan(steer) / dt
    slip_rate = tan_rate * p.lr / wheelbase * cos_slip * cos_slip
    yaw_acceleration = (
        acceleration * cos_slip * tan_steer - speed * sin_slip * slip_rate * tan_steer + speed * cos_slip * tan_rate
    ) / wheelbase
    return (
        speed * (cos_yaw * cos_slip - sin_yaw * sin_slip),
        speed * (sin_yaw * cos_slip + cos_yaw * sin_slip),
        steer_rate,
        acceleration,
        speed * cos_slip * tan_steer / wheelbase,
        yaw_acceleration,
        slip_rate,
        0.0,
        0.0,
    )


@njit(cache=True, error_model="numpy")
def single_track(state, steer_rate, acceleration, p):
    """Time derivative of a state under the single-track model; wheel speeds have none."""
    _, _, steer, speed, yaw, yaw_rate, slip, _, _ = state
    if is_kinematic(speed, p):
        return kinematic(state, steer_rate, acceleration, p)
    front_load, rear_load = axle_loads(acceleration, p)
    direction = 1.0 if speed > 0.0 else -1.0
    inverse_speed = 1.0 / speed
    # Lateral forces divided by mass [m/s^2].
    friction = 1.0 * p.mu * p.road_friction
    front = direction * friction * p.C_Sf * front_load * (steer - slip - p.lf * yaw_rate * inverse_speed)
    rear = direction * friction * p.C_Sr * rear_load * (p.lr * yaw_rate * inverse_speed - slip)
    course = slip + yaw
    return (
        speed * math.cos(course),
        speed * math.sin(course),
        steer_rate,
        acceleration,
        yaw_rate,
        (p.lf * front - p.lr * rear) * (p.m / p.I),
        (front + rear) * inverse_speed - yaw_rate,
        0.0,
        0.0,
    )


@njit(cache=True, error_model="numpy")
def is_kinematic(speed, p):
    """Whether the single-track model is kinematic at this speed [m/s], forwards or in reverse."""
    return abs(speed) < max(1.0 * p.kinematic_speed, LOWEST_KINEMATIC_SPEED)


@njit(cache=True, error_model="numpy")
def kinematic_speed(p, dt, integrator=RK4):
    """The speed [m/s] below which the single-track model with linear tyres must become kinematic.

    Args:
        p: the car's parameters.
        dt: physics step [s].
        integrator: EULER or RK4.
    """
    return slowest_stable_speed(p.mu * p.C_Sf, p.mu * p.C_Sr, p, dt, integrator)


@njit(cache=True, error_model="numpy")
def slowest_stable_speed(front_slope, rear_slope, p, dt, integrator):
    """The speed [m/s] below which a dynamic single-track model must become kinematic.

    The lateral modes of the single-track get faster as 1 / speed. Below this speed their rate times `dt`
    leaves the integrator's region of stability. At least 0.5 m/s, the F1TENTH gym's value.

    Args:
        front_slope, rear_slope: of the axles' lateral force / load over the slip angle, at the origin [1/rad].
        p: the car's parameters.
        dt: physics step [s].
        integrator: EULER or RK4.
    """
    fastest = 0.0
    # The rate is convex in the axle loads: its largest value is at one end of the load transfer.
    for sign in (-1.0, 1.0):
        front_load, rear_load = axle_loads(sign * p.a_max, p)
        rate = lateral_rate(front_slope * front_load, rear_slope * rear_load, p)
        fastest = max(fastest, rate)
    return max(0.5, fastest * dt / stability_bound(integrator))


@njit(cache=True, error_model="numpy")
def kinematic_values(steer, speed, p):
    """(yaw rate [rad/s], slip angle [rad]) of a car whose wheels do not slip."""
    wheelbase = 1.0 * p.lf + p.lr
    tan_steer = math.tan(steer)
    tan_slip = tan_steer * p.lr / wheelbase
    return speed * tan_steer / (wheelbase * math.sqrt(1.0 + tan_slip * tan_slip)), math.atan(tan_slip)


@njit(cache=True, error_model="numpy")
def rolling_wheel_speeds(steer, speed, yaw_rate, slip, p):
    """(front, rear) wheel speeds [rad/s] at which the wheels roll without longitudinal slip."""
    forward = speed * math.cos(slip)
    leftward = speed * math.sin(slip) + yaw_rate * p.lf
    front = forward * math.cos(steer) + leftward * math.sin(steer)
    return front / p.wheel_radius, forward / p.wheel_radius


@njit(cache=True, error_model="numpy")
def axle_loads(acceleration, p):
    """Vertical forces on the (front, rear) axle divided by mass [m/s^2], under load transfer."""
    wheelbase = 1.0 * p.lf + p.lr
    front = (GRAVITY * p.lr - acceleration * p.h) / wheelbase
    front = min(max(front, 0.0), GRAVITY)
    return front, GRAVITY - front


@njit(cache=True, error_model="numpy")
def lateral_rate(front_stiffness, rear_stiffness, p):
    """The largest eigenvalue of the linearised (slip, yaw rate) dynamics as speed tends to 0, times speed.

    Args:
        front_stiffness: lateral force / (slip angle mass) [m/s^2].
        rear_stiffness: the same of the rear axle.

    Returns:
        [m/s^2]; divided by speed, the rate [1/s] at which the fastest lateral mode decays.
    """
    ratio = 1.0 * p.m / p.I
    slip_damping = front_stiffness + rear_stiffness
    yaw_damping = ratio * (p.lf * p.lf * front_stiffness + p.lr * p.lr * rear_stiffness)
    coupling = p.lr * rear_stiffness - p.lf * front_stiffness
    return 0.5 * (
        slip_damping + yaw_damping + math.sqrt((slip_damping - yaw_damping) ** 2 + 4.0 * ratio * coupling * coupling)
    )


@njit(cache=True, error_model="numpy")
def stability_bound(integrator):
    """The largest rate times step to allow a decaying mode, with a margin (2.78 for RK4, 2 for Euler)."""
    return 1.0 if integrator == EULER else 2.0


@njit(cache=True, error_model="numpy")
def wrap_angle(angle):
    """An angle [rad] in (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    wrapped = angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))
    return wrapped if -math.pi < wrapped <= math.pi else math.pi
