"""What a car measures of its own motion: true values with the errors of its sensors."""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

import numpy as np
from numba import njit

from outlap.simulator import state as column
from outlap.simulator.lidar import NORMAL, QUANTILES
from outlap.simulator.seeding import hash64
from outlap.simulator.worlds import FORWARD, LEFTWARD, SLIP, STEER, VESC, YAW_RATE

MOTION_STREAM = np.uint64(1) << np.uint64(40)  # beyond the number of any beam


@njit(cache=True, error_model="numpy")
def measure(constants, worlds, w, c):
    """Write what a car measures of its motion to `worlds.measured`.

    The steering angle is the one that the servo was asked for: it knows neither trim nor ratio. With the odometry of a
    stock VESC there is no lateral speed, and the yaw rate is that of a car whose wheels do not slip.

    Args:
        constants, worlds: see `worlds`.
        w, c: number of the world and of the car.
    """
    p, state, out = worlds.params[w, c], worlds.state[w, c], worlds.measured[w, c]
    speed, slip, steer = float(state[column.SPEED]), float(state[column.SLIP]), float(state[column.STEER])
    forward = p.speed_scale * speed * math.cos(slip)
    leftward = p.speed_scale * speed * math.sin(slip)
    yaw_rate = float(state[column.YAW_RATE]) + p.yaw_rate_bias
    steer = (steer - p.steer_trim) / p.steer_ratio
    if p.speed_noise > 0.0 or p.yaw_rate_noise > 0.0:
        key = hash64(hash64(worlds.key[w], np.uint64(worlds.tick[w])), np.uint64(c))
        bits = hash64(key, MOTION_STREAM)
        forward += p.speed_noise * NORMAL[bits & np.uint64(QUANTILES - 1)]
        leftward += p.speed_noise * NORMAL[(bits >> np.uint64(16)) & np.uint64(QUANTILES - 1)]
        yaw_rate += p.yaw_rate_noise * NORMAL[(bits >> np.uint64(32)) & np.uint64(QUANTILES - 1)]
        slip = math.atan(leftward / forward) if forward != 0.0 else math.copysign(0.5 * math.pi, leftward)
    if constants.odometry == VESC:
        leftward = 0.0
        slip = 0.0
        yaw_rate = forward * math.tan(steer) / (p.lf + p.lr)
    out[FORWARD] = forward
    out[LEFTWARD] = leftward
    out[YAW_RATE] = yaw_rate
    out[STEER] = steer
    out[SLIP] = slip
