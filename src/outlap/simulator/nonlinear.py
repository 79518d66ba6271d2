"""The nonlinear single-track model: saturating tyres that share their grip between driving and cornering.

Lateral axle forces follow the Magic Formula (Pacejka, Tire and Vehicle Dynamics, 2012, section 4.3.1), normalised so
that `mu` is the peak friction coefficient. Longitudinal and lateral force of an axle lie within a friction ellipse.
Wheels have no spin of their own: a force beyond the grip slides the wheel, so that nothing here is stiff.

Velocities are those of the centre of gravity in the car's frame, forward u and leftward v, which have no singularity at
a standstill. Below `p.kinematic_speed` the car is a kinematic bicycle, forwards and in reverse.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

from outlap.simulator.bicycle import GRAVITY, axle_loads
from outlap.simulator.elementary import CONTRACT, HALF_PI, arctangent, arctangent_of_ratio, cosine_wide, sine_wide


@njit(cache=True, error_model="numpy", fastmath=CONTRACT)
def largest_slope_angle(stiffness, curvature):
    """B a at which the Magic Formula's argument stops to grow; the slip angle has no effect beyond it.

    The argument B a - E (B a - arctan(B a)) grows for ever where E <= 1.
    """
    farthest = stiffness * HALF_PI
    if curvature > 1.0:
        farthest = min(farthest, 1.0 / math.sqrt(curvature - 1.0))
    return farthest


@njit(cache=True, error_model="numpy", fastmath=CONTRACT)
def axle_scale(stiffness, shape, curvature):
    """The factor of the Magic Formula's sine that makes its largest value up to a slip angle of pi / 2 one.

    Args:
        stiffness, shape, curvature: B [1/rad], C [-], E [-].
    """
    x = largest_slope_angle(1.0 * stiffness, 1.0 * curvature)
    angle = shape * math.atan(x - curvature * (x - math.atan(x)))
    return 1.0 / math.sin(min(angle, HALF_PI))


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, forceinline=True)
def lateral_share(sideways, forward, slowest, stiffness, shape, curvature, scale):
    """The lateral force of an axle that rolls freely / its grip, positive to the left.

    Args:
        sideways, forward: velocity of the axle in the frame of its wheel [m/s].
        slowest: least divisor of the slip angle's tangent [m/s].
        stiffness, shape, curvature: B [1/rad], C [-], E [-].
        scale: of `axle_scale`.
    """
    x = stiffness * arctangent_of_ratio(abs(sideways), max(abs(forward), slowest))
    if curvature != 0.0:
        if curvature > 1.0:
            x = min(x, 1.0 / math.sqrt(curvature - 1.0))
        x -= curvature * (x - arctangent(x))
    return math.copysign(scale * sine_wide(shape * arctangent(x)), -sideways)


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, forceinline=True)
def axle_demands(u, acceleration, p):
    """What a step asks of the axles, constant over it.

    Args:
        u: forward velocity [m/s].
        acceleration: force of motor or brakes / mass [m/s^2].
        p: the car's parameters.

    Returns:
        front_grip, rear_grip: largest force of the axle / mass [m/s^2].
        front_demand, rear_demand: longitudinal force / grip [-], within `p.grip_share`.
    """
    friction = 1.0 * p.mu * p.road_friction
    transfer = min(max(acceleration, -friction * GRAVITY), friction * GRAVITY)
    front_load, rear_load = axle_loads(transfer, p)
    front_grip = max(friction * p.front_peak * front_load, 1e-9)
    rear_grip = max(friction * p.rear_peak * rear_load, 1e-9)
    split = 1.0 * p.engine_split if acceleration * u >= 0.0 else 1.0 * p.brake_split
    most = 1.0 * p.grip_share
    front_demand = min(max(split * acceleration / front_grip, -most), most)
    rear_demand = min(max((1.0 - split) * acceleration / rear_grip, -most), most)
    return front_grip, rear_grip, front_demand, rear_demand


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, forceinline=True)
def axle_shares(demand, sliding, rolling, most, slowest, stiffness, shape, curvature, scale):
    """The forces of an axle / its grip, within the friction ellipse: longitudinal, lateral.

    A wheel that brakes beyond its grip locks: its force then opposes its motion, whichever way it slides.

    Args:
        demand: longitudinal force that motor or brakes ask for / grip, within `most` [-].
        sliding, rolling: velocity of the axle in the frame of its wheel, leftward and forward [m/s].
        most: largest share of the grip for a longitudinal force [-].
        slowest, stiffness, shape, curvature, scale: see `lateral_share`.
    """
    lateral = lateral_share(sliding, rolling, slowest, stiffness, shape, curvature, scale)
    if demand * rolling < 0.0:
        squared = rolling * rolling + sliding * sliding
        if demand * demand * squared > most * most * rolling * rolling:
            demand = math.copysign(most * abs(rolling) / math.sqrt(squared), demand)
    return demand, lateral * math.sqrt(max(1.0 - demand * demand, 0.0))


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, forceinline=True)
def nonlinear_rates(u, v, yaw_rate, cos_steer, sin_steer, demands, slowest, p):
    """The time derivatives of the motion in the car's frame, as for a car above `p.kinematic_speed`.

    Args:
        u, v: velocity forward and to the left [m/s].
        yaw_rate: [rad/s].
        cos_steer, sin_steer: of the steering angle.
        demands: of `axle_demands`.
        slowest: least divisor of a slip angle's tangent [m/s].
        p: the car's parameters.

    Returns:
        du/dt [m/s^2], dv/dt [m/s^2], d yaw_rate / dt [rad/s^2].
    """
    front_grip, rear_grip, front_demand, rear_demand = demands
    most = 1.0 * p.grip_share
    front_leftward = v + p.lf * yaw_rate
    front_x, front_y = axle_shares(
        front_demand, front_leftward * cos_steer - u * sin_steer, u * cos_steer + front_leftward * sin_steer,
        most, slowest, p.front_B, p.front_C, p.front_E, p.front_scale,
    )  # fmt: skip
    rear_x, rear_y = axle_shares(
        rear_demand, v - p.lr * yaw_rate, u, most, slowest, p.rear_B, p.rear_C, p.rear_E, p.rear_scale
    )
    front_x *= front_grip
    front_y *= front_grip
    rear_y *= rear_grip
    front_leftward_force = front_y * cos_steer + front_x * sin_steer
    return (
        rear_x * rear_grip + front_x * cos_steer - front_y * sin_steer + v * yaw_rate,
        rear_y + front_leftward_force - u * yaw_rate,
        (p.lf * front_leftward_force - p.lr * rear_y) * (p.m / p.I),
    )


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, forceinline=True)
def _turned(cos, sin, angle):
    """(cos, sin) of an angle after a turn of less than 0.6 rad, to 1e-10."""
    y = angle * angle
    z = y * y
    c = (1.0 - 0.5 * y) + z * ((1 / 24 - (1 / 720) * y) + z * (1 / 40320 - (1 / 3628800) * y))
    s = angle * ((1.0 - (1 / 6) * y) + z * ((1 / 120 - (1 / 5040) * y) + (1 / 362880) * z))
    return cos * c - sin * s, sin * c + cos * s


@njit(cache=True, error_model="numpy", fastmath=CONTRACT)
def nonlinear_step(rk4, state, steer_rate, acceleration, dt, p):
    """A state after one step of the model above `p.kinematic_speed`.

    Args:
        rk4: whether to take a step of the classical Runge-Kutta method, otherwise one of Euler's.
        state: tuple in the order of `state`.
        steer_rate: [rad/s], and
        acceleration: force of motor or brakes / mass [m/s^2], constant over the step.
        dt: [s].
        p: the car's parameters.

    Returns:
        The next x, y, steer, speed, yaw, yaw rate and slip; slip is within pi / 2, speed negative in reverse.
    """
    x, y, steer, speed, yaw, yaw_rate, slip, _, _ = state
    slowest = max(1.0 * p.kinematic_speed, 0.1)
    u = speed * cosine_wide(slip)
    v = speed * sine_wide(slip)
    cos_yaw, sin_yaw = cosine_wide(yaw), sine_wide(yaw)
    cos_steer, sin_steer = cosine_wide(steer), sine_wide(steer)
    demands = axle_demands(u, acceleration, p)
    a0, a1, a2 = nonlinear_rates(u, v, yaw_rate, cos_steer, sin_steer, demands, slowest, p)
    vx, vy, turn, du, dv, dr = u * cos_yaw - v * sin_yaw, u * sin_yaw + v * cos_yaw, yaw_rate, a0, a1, a2
    if rk4:
        half = 0.5 * dt
        mid_cos, mid_sin = _turned(cos_steer, sin_steer, half * steer_rate)
        end_cos, end_sin = _turned(cos_steer, sin_steer, dt * steer_rate)

        ub, vb, rb = u + half * a0, v + half * a1, yaw_rate + half * a2
        cos_b, sin_b = _turned(cos_yaw, sin_yaw, half * yaw_rate)
        b0, b1, b2 = nonlinear_rates(ub, vb, rb, mid_cos, mid_sin, demands, slowest, p)

        uc, vc, rc = u + half * b0, v + half * b1, yaw_rate + half * b2
        cos_c, sin_c = _turned(cos_yaw, sin_yaw, half * rb)
        c0, c1, c2 = nonlinear_rates(uc, vc, rc, mid_cos, mid_sin, demands, slowest, p)

        ud, vd, rd = u + dt * c0, v + dt * c1, yaw_rate + dt * c2
        cos_d, sin_d = _turned(cos_yaw, sin_yaw, dt * rc)
        d0, d1, d2 = nonlinear_rates(ud, vd, rd, end_cos, end_sin, demands, slowest, p)

        k = 1.0 / 6.0
        vx = k * (vx + 2.0 * (ub * cos_b - vb * sin_b + uc * cos_c - vc * sin_c) + ud * cos_d - vd * sin_d)
        vy = k * (vy + 2.0 * (ub * sin_b + vb * cos_b + uc * sin_c + vc * cos_c) + ud * sin_d + vd * cos_d)
        turn = k * (turn + 2.0 * (rb + rc) + rd)
        du = k * (a0 + 2.0 * (b0 + c0) + d0)
        dv = k * (a1 + 2.0 * (b1 + c1) + d1)
        dr = k * (a2 + 2.0 * (b2 + c2) + d2)
    u += dt * du
    v += dt * dv
    direction = 1.0 if u >= 0.0 else -1.0
    speed = direction * math.sqrt(u * u + v * v)
    slip = direction * math.copysign(arctangent_of_ratio(abs(v), max(abs(u), 1e-300)), v)
    return x + dt * vx, y + dt * vy, steer + dt * steer_rate, speed, yaw + dt * turn, yaw_rate + dt * dr, slip
