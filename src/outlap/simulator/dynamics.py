"""Vehicle dynamics: one physics step of a car, under four models and two integrators.

- KINEMATIC: wheels that never slip (`bicycle.kinematic`).
- SINGLE_TRACK: linear tyres under load transfer; kinematic below `p.kinematic_speed` (`bicycle.single_track`).
- NONLINEAR_SINGLE_TRACK: saturating tyres, a motor with a force and a power; kinematic below `p.kinematic_speed`
  (`nonlinear.nonlinear_step`).
- DRIFT: Pacejka tyres with combined slip and spinning wheels (`drift.drift`).

Scalar functions. A state is a tuple in the order of `state`, float64; `p` is one car's parameters. The
inputs are within the car's limits (`actuators`) and constant over a step. No function calls NumPy: the same
source compiles for CUDA.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

from outlap.simulator.bicycle import (
    EULER,
    GRAVITY,
    RK4,
    is_kinematic,
    kinematic,
    kinematic_speed,
    kinematic_values,
    rolling_wheel_speeds,
    single_track,
    slowest_stable_speed,
    wrap_angle,
)
from outlap.simulator.drift import BLEND_SPEED, RELAXATION_TIME, drift, drift_substeps, drift_weight
from outlap.simulator.nonlinear import axle_scale, nonlinear_step

__all__ = [
    "DRIFT",
    "EULER",
    "KINEMATIC",
    "NONLINEAR_SINGLE_TRACK",
    "RK4",
    "SINGLE_TRACK",
    "derive",
    "drift",
    "integrate",
    "kinematic",
    "kinematic_speed",
    "kinematic_values",
    "rolling_wheel_speeds",
    "single_track",
    "wrap_angle",
]

KINEMATIC, SINGLE_TRACK, DRIFT, NONLINEAR_SINGLE_TRACK = range(4)

# What no car exceeds, and a spinning one may under linear tyres or far outside a tyre's table.
HIGHEST_YAW_RATE = 50.0  # [rad/s] eight turns a second
HIGHEST_WHEEL_SPEED = 1.2  # times v_max / wheel_radius: the motor's limit under wheelspin, and so the car's


@njit(cache=True, error_model="numpy")
def derive(model, integrator, dt, p):
    """Set what a model needs of a car's parameters beforehand: those of `vehicle.DERIVED`.

    Args:
        model, integrator, dt: as for `integrate`.
        p: the car's parameters, changed in place.
    """
    p.road_friction = 1.0
    p.front_scale = axle_scale(p.front_B, p.front_C, p.front_E)
    p.rear_scale = axle_scale(p.rear_B, p.rear_C, p.rear_E)
    if model == NONLINEAR_SINGLE_TRACK:
        front_slope = p.mu * p.front_peak * p.front_scale * p.front_C * p.front_B
        rear_slope = p.mu * p.rear_peak * p.rear_scale * p.rear_C * p.rear_B
        p.kinematic_speed = slowest_stable_speed(front_slope, rear_slope, p, dt, integrator)
    else:
        p.kinematic_speed = kinematic_speed(p, dt, integrator)


@njit(cache=True, error_model="numpy")
def integrate(model, integrator, state, steer_rate, acceleration, dt, p):
    """A car's state after one physics step.

    Where the wheels do not slip (the kinematic model; the single-track below `p.kinematic_speed`), yaw rate
    and slip angle are set to what the geometry says, so that no error builds up; without the drift model,
    wheel speeds follow the car's speed. The drift model takes as many internal steps as its stiff wheels
    and tyres need at the present speed (`drift.drift_substeps`).

    Args:
        model: KINEMATIC, SINGLE_TRACK, DRIFT or NONLINEAR_SINGLE_TRACK.
        integrator: EULER or RK4 (classical, fourth order).
        state: tuple of N_STATE numbers, see `state`.
        steer_rate: [rad/s] and
        acceleration: [m/s^2], within the car's limits, constant over the step; under NONLINEAR_SINGLE_TRACK the force
            of motor or brakes divided by mass, of which the tyres transmit what they can.
        dt: [s].
        p: the car's parameters.

    Returns:
        The next state: yaw and slip in (-pi, pi]. Where tyres slip, yaw rate is within 50 rad/s; under SINGLE_TRACK
        and NONLINEAR_SINGLE_TRACK slip is within pi / 2, under DRIFT speed within 1.2 times v_min … v_max. Whatever the
        car and the driver, the state stays finite.
    """
    if model == DRIFT:
        return _substepped_drift(integrator, state, steer_rate, acceleration, dt, p)
    if model == NONLINEAR_SINGLE_TRACK:
        return _nonlinear_or_kinematic(integrator, state, steer_rate, acceleration, dt, p)
    if model == KINEMATIC:
        state = _kinematic_step(integrator, state, steer_rate, acceleration, dt, p)
    else:
        state = _single_track_step(integrator, state, steer_rate, acceleration, dt, p)
    x, y, steer, speed, yaw, yaw_rate, slip, _, _ = state
    if model == KINEMATIC or is_kinematic(speed, p):
        yaw_rate, slip = kinematic_values(steer, speed, p)
    else:
        # Linear tyres never let go: an oversteering car above its critical speed would diverge. Sideways is
        # as far as the model can mean anything.
        slip = min(max(slip, -0.5 * math.pi), 0.5 * math.pi)
        yaw_rate = min(max(yaw_rate, -HIGHEST_YAW_RATE), HIGHEST_YAW_RATE)
    wheel_speed = speed / p.wheel_radius
    return x, y, steer, speed, wrap_angle(yaw), yaw_rate, slip, wheel_speed, wheel_speed


@njit(cache=True, error_model="numpy")
def _nonlinear_or_kinematic(integrator, state, steer_rate, acceleration, dt, p):
    """A step of the nonlinear single-track model: kinematic below `p.kinematic_speed`, forwards and in reverse."""
    if is_kinematic(state[3], p):
        grip = p.grip_share * p.mu * p.road_friction * GRAVITY
        push = min(max(acceleration, -grip), grip)
        x, y, steer, speed, yaw, yaw_rate, slip, _, _ = _kinematic_step(integrator, state, steer_rate, push, dt, p)
    else:
        x, y, steer, speed, yaw, yaw_rate, slip = nonlinear_step(
            integrator == RK4, state, steer_rate, acceleration, dt, p
        )
    if is_kinematic(speed, p):
        yaw_rate, slip = kinematic_values(steer, speed, p)
    yaw_rate = min(max(yaw_rate, -HIGHEST_YAW_RATE), HIGHEST_YAW_RATE)
    wheel_speed = speed / p.wheel_radius
    return x, y, steer, speed, wrap_angle(yaw), yaw_rate, slip, wheel_speed, wheel_speed


@njit(cache=True, error_model="numpy")
def _substepped_drift(integrator, state, steer_rate, acceleration, dt, p):
    """A drift step, cut into as many equal ones as its stiff wheels and tyres need at this speed."""
    count = drift_substeps(integrator, state, acceleration, dt, p)
    h = dt / count
    fastest = HIGHEST_WHEEL_SPEED * p.v_max
    fastest_back = min(HIGHEST_WHEEL_SPEED * p.v_min, -BLEND_SPEED)  # below which a spin ends in reverse
    fastest_wheel = fastest / p.wheel_radius
    x, y, steer, speed, yaw, yaw_rate, slip, front, rear = state
    for _ in range(count):
        x, y, steer, speed, yaw, yaw_rate, slip, front, rear = _drift_step(
            integrator, (x, y, steer, speed, yaw, yaw_rate, slip, front, rear),
            steer_rate, acceleration, h, p,
        )  # fmt: skip
        speed = min(max(speed, fastest_back), fastest)
        yaw = wrap_angle(yaw)
        slip = wrap_angle(slip)
        yaw_rate = min(max(yaw_rate, -HIGHEST_YAW_RATE), HIGHEST_YAW_RATE)
        front = min(max(front, 0.0), fastest_wheel)
        rear = min(max(rear, 0.0), fastest_wheel)
        if abs(speed) < BLEND_SPEED and abs(slip) > 0.5 * math.pi:
            # A car that ends a spin backwards is one that reverses.
            speed = -speed
            slip -= math.copysign(math.pi, slip)
        # What is left of a spin must not stay for ever in a car that now rolls: relax, as the wheels do.
        share = (1.0 - drift_weight(speed)) * h / (h + RELAXATION_TIME)
        rolling_yaw_rate, rolling_slip = kinematic_values(steer, speed, p)
        yaw_rate += share * (rolling_yaw_rate - yaw_rate)
        slip += share * (rolling_slip - slip)
    return x, y, steer, speed, yaw, yaw_rate, slip, front, rear


# The step is written out for each model: a function passed as an argument would keep Numba from caching its
# callers, and a branch inside the derivative costs half as much again.
@njit(cache=True, error_model="numpy")
def _kinematic_step(integrator, state, steer_rate, acceleration, dt, p):
    a = kinematic(state, steer_rate, acceleration, p)
    if integrator == EULER:
        return _advance(state, a, dt)
    b = kinematic(_advance(state, a, 0.5 * dt), steer_rate, acceleration, p)
    c = kinematic(_advance(state, b, 0.5 * dt), steer_rate, acceleration, p)
    d = kinematic(_advance(state, c, dt), steer_rate, acceleration, p)
    return _advance(state, _rk4_rate(a, b, c, d), dt)


@njit(cache=True, error_model="numpy")
def _single_track_step(integrator, state, steer_rate, acceleration, dt, p):
    a = single_track(state, steer_rate, acceleration, p)
    if integrator == EULER:
        return _advance(state, a, dt)
    b = single_track(_advance(state, a, 0.5 * dt), steer_rate, acceleration, p)
    c = single_track(_advance(state, b, 0.5 * dt), steer_rate, acceleration, p)
    d = single_track(_advance(state, c, dt), steer_rate, acceleration, p)
    return _advance(state, _rk4_rate(a, b, c, d), dt)


@njit(cache=True, error_model="numpy")
def _drift_step(integrator, state, steer_rate, acceleration, dt, p):
    a = drift(state, steer_rate, acceleration, p)
    if integrator == EULER:
        return _advance(state, a, dt)
    b = drift(_advance(state, a, 0.5 * dt), steer_rate, acceleration, p)
    c = drift(_advance(state, b, 0.5 * dt), steer_rate, acceleration, p)
    d = drift(_advance(state, c, dt), steer_rate, acceleration, p)
    return _advance(state, _rk4_rate(a, b, c, d), dt)


@njit(cache=True, error_model="numpy")
def _rk4_rate(a, b, c, d):
    """The mean of four derivatives with the weights of the classical Runge-Kutta method."""
    k = 1.0 / 6.0
    return (
        k * (a[0] + 2.0 * (b[0] + c[0]) + d[0]), k * (a[1] + 2.0 * (b[1] + c[1]) + d[1]),
        k * (a[2] + 2.0 * (b[2] + c[2]) + d[2]), k * (a[3] + 2.0 * (b[3] + c[3]) + d[3]),
        k * (a[4] + 2.0 * (b[4] + c[4]) + d[4]), k * (a[5] + 2.0 * (b[5] + c[5]) + d[5]),
        k * (a[6] + 2.0 * (b[6] + c[6]) + d[6]), k * (a[7] + 2.0 * (b[7] + c[7]) + d[7]),
        k * (a[8] + 2.0 * (b[8] + c[8]) + d[8]),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _advance(s, d, h):
    return (
        s[0] + h * d[0], s[1] + h * d[1], s[2] + h * d[2], s[3] + h * d[3], s[4] + h * d[4],
        s[5] + h * d[5], s[6] + h * d[6], s[7] + h * d[7], s[8] + h * d[8],
    )  # fmt: skip
