"""From commands to what the dynamics take: a steering rate and an acceleration, within the car's limits.

Scalar functions of one car's parameter row `p`, applied once per integrator step.
"""

from __future__ import annotations

import math

from numba import njit

from outlap.simulator.vehicle import (
    A_MAX,
    SPEED_DELAY,
    SPEED_GAIN,
    STEER_DELAY,
    STEER_GAIN,
    STEER_MAX,
    STEER_MIN,
    STEER_RATE_MAX,
    V_MAX,
    V_MIN,
    V_SWITCH,
)


@njit(cache=True, error_model="numpy")
def limit_steering_rate(rate, steer, p):
    """A steering rate [rad/s] within the motor's limit, and none outwards at a stop."""
    if (steer <= p[STEER_MIN] and rate <= 0.0) or (steer >= p[STEER_MAX] and rate >= 0.0):
        return 0.0
    return min(max(1.0 * rate, -p[STEER_RATE_MAX]), 1.0 * p[STEER_RATE_MAX])


@njit(cache=True, error_model="numpy")
def limit_acceleration(acceleration, speed, p):
    """An acceleration [m/s^2] within what grip, motor power and the speed limits allow.

    Source: Althoff and Würsching, CommonRoad: Vehicle Models, 2020, section 4, equation (3).
    """
    if (speed <= p[V_MIN] and acceleration <= 0.0) or (speed >= p[V_MAX] and acceleration >= 0.0):
        return 0.0
    largest = 1.0 * p[A_MAX]
    forward = largest
    if speed > p[V_SWITCH]:  # constant power
        forward = largest * p[V_SWITCH] / speed
    return min(max(1.0 * acceleration, -largest), forward)


@njit(cache=True, error_model="numpy")
def steering_rate(target, steer, dt, p):
    """The rate [rad/s] at which the servo turns towards a target angle.

    Proportional, within the rate limit; never so fast that a step passes the target, which makes a
    gain of 1 / dt or more a bang-bang controller that lands on it.

    Args:
        target: commanded angle [rad]; one beyond a stop means the stop.
        steer: present angle [rad].
        dt: physics step [s].
    """
    error = min(max(1.0 * target, 1.0 * p[STEER_MIN]), 1.0 * p[STEER_MAX]) - steer
    return limit_steering_rate(min(1.0 * p[STEER_GAIN], 1.0 / dt) * error, steer, p)


@njit(cache=True, error_model="numpy")
def acceleration(target_speed, speed, p):
    """The acceleration [m/s^2] with which the motor controller follows a target speed [m/s].

    Proportional, with the F1TENTH gym's four gains: 10 a_max / v for a car that moves forward and
    2 a_max / v otherwise, where v is v_max to gain speed and -v_min to lose it. A car that hardly reverses
    would get an unbounded gain: -v_min counts as at least v_max / 10.
    """
    error = target_speed - speed
    if error == 0.0:  # a car that can neither drive nor reverse has no gain
        return 0.0
    gain = 1.0 * p[SPEED_GAIN]
    if speed <= 0.0:
        gain *= 0.2
    scale = 1.0 * p[V_MAX]
    if error <= 0.0:
        scale = max(-1.0 * p[V_MIN], 0.1 * scale)
    return limit_acceleration(gain * p[A_MAX] / scale * error, speed, p)


@njit(cache=True, error_model="numpy")
def lag(value, command, dt, time_constant):
    """A first-order lag, exact for a command held over the step: the next value.

    Args:
        value: present output.
        command: input, constant over the step.
        dt: physics step [s].
        time_constant: [s]; 0 passes the command through.
    """
    if time_constant <= 0.0:
        return 1.0 * command
    return value + (1.0 - math.exp(-dt / time_constant)) * (command - value)


@njit(cache=True, error_model="numpy")
def delay_steps(p, dt):
    """The physics steps by which the (steering, speed) commands come late: the nearest whole numbers."""
    return int(p[STEER_DELAY] / dt + 0.5), int(p[SPEED_DELAY] / dt + 0.5)
