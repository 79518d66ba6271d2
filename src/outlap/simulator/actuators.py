"""From commands to what the dynamics take: a steering rate and an acceleration, within the car's limits.

Scalar functions of one car's parameters `p`, applied once per integrator step.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, error_model="numpy")
def limit_steering_rate(rate, steer, p):
    """A steering rate [rad/s] within the motor's limit, and none outwards at a stop."""
    if (steer <= p.steer_min and rate <= 0.0) or (steer >= p.steer_max and rate >= 0.0):
        return 0.0
    return min(max(1.0 * rate, -p.steer_rate_max), 1.0 * p.steer_rate_max)


@njit(cache=True, error_model="numpy")
def limit_acceleration(acceleration, speed, p):
    """An acceleration [m/s^2] within what grip, motor power and the speed limits allow.

    Source: Althoff and Würsching, CommonRoad: Vehicle Models, 2020, section 4, equation (3).
    """
    if (speed <= p.v_min and acceleration <= 0.0) or (speed >= p.v_max and acceleration >= 0.0):
        return 0.0
    largest = 1.0 * p.a_max
    forward = largest
    if speed > p.v_switch:  # constant power
        forward = largest * p.v_switch / speed
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
    error = min(max(1.0 * target, 1.0 * p.steer_min), 1.0 * p.steer_max) - steer
    return limit_steering_rate(min(1.0 * p.steer_gain, 1.0 / dt) * error, steer, p)


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
    gain = 1.0 * p.speed_gain
    if speed <= 0.0:
        gain *= 0.2
    scale = 1.0 * p.v_max
    if error <= 0.0:
        scale = max(-1.0 * p.v_min, 0.1 * scale)
    return limit_acceleration(gain * p.a_max / scale * error, speed, p)


@njit(cache=True, error_model="numpy")
def motor_force(target_speed, speed, p):
    """The force [N] with which a car's motor controller follows a target speed [m/s].

    Proportional to the error, as the speed loop of a motor controller, which knows no mass.

    Args:
        target_speed: [m/s].
        speed: of the wheels, forward [m/s].
        p: the car's parameters.
    """
    return limit_force(p.force_gain * (target_speed - speed), speed, p)


@njit(cache=True, error_model="numpy")
def limit_force(force, speed, p):
    """A force [N] within what motor, its power, its highest speeds and the brakes allow.

    A force against the motion is the brakes'; one along it is the motor's, of `motor_power` / |speed| at most.

    Args:
        force: positive forward [N].
        speed: of the wheels, forward [m/s].
        p: the car's parameters.
    """
    if force * speed < 0.0:
        return min(max(force, -1.0 * p.brake_force), 1.0 * p.brake_force)
    if (speed >= p.v_max and force > 0.0) or (speed <= p.v_min and force < 0.0):
        return 0.0
    most = min(1.0 * p.motor_force, p.motor_power / max(abs(speed), 1e-3))
    return min(max(force, -most), most)


@njit(cache=True, error_model="numpy")
def ramp(value, command, dt, p):
    """A commanded speed [m/s] that follows `command` no faster than `speed_ramp_up` and `speed_ramp_down` allow.

    Args:
        value: its value one step before [m/s].
        command: [m/s].
        dt: physics step [s].
        p: the car's parameters.
    """
    if p.speed_ramp_up > 0.0:
        command = min(command, value + p.speed_ramp_up * dt)
    if p.speed_ramp_down > 0.0:
        command = max(command, value - p.speed_ramp_down * dt)
    return command


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
    return int(p.steer_delay / dt + 0.5), int(p.speed_delay / dt + 0.5)
