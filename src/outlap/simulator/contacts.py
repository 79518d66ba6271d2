"""Contacts of a physics step: which cars touched a wall or each other on their way, and where they stop."""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

from outlap.simulator import state as column
from outlap.simulator.bicycle import wrap_angle
from outlap.simulator.collision import FREE, HIT_CAR, HIT_WALL, REMOVED, rectangles_overlap, touches_wall


@njit(cache=True, error_model="numpy", forceinline=True)
def collide(atlas, worlds, w):
    """Find contacts on the way of the last physics step and park the cars that made one."""
    cars = worlds.state.shape[1]
    # Poses in between are tested too, no further apart than half of a car's shorter side: then nothing is jumped
    # over, and a car is parked before its middle is in the wall, however it slides.
    checks = 1
    for c in range(cars):
        dx = worlds.state[w, c, column.X] - worlds.before[w, c, 0]
        dy = worlds.state[w, c, column.Y] - worlds.before[w, c, 1]
        moved = math.sqrt(dx * dx + dy * dy)
        shorter = min(worlds.params[w, c].length, worlds.params[w, c].width)
        checks = max(checks, math.ceil(2.0 * moved / shorter))
    track = worlds.track[w]
    for check in range(1, checks + 1):
        share = check / checks
        for c in range(cars):
            if worlds.contact[w, c] != FREE:
                continue
            x, y, yaw = _between(worlds, w, c, share)
            length, width = 0.5 * worlds.params[w, c].length, 0.5 * worlds.params[w, c].width
            if touches_wall(atlas, track, x, y, yaw, length, width):
                _park(worlds, w, c, x, y, yaw, HIT_WALL, abs(worlds.state[w, c, column.SPEED]))
        for c in range(cars):
            for other in range(c):
                if worlds.contact[w, c] != FREE and worlds.contact[w, other] != FREE:
                    continue
                if worlds.contact[w, c] == REMOVED or worlds.contact[w, other] == REMOVED:
                    continue
                x1, y1, yaw1 = _between(worlds, w, c, share)
                x2, y2, yaw2 = _between(worlds, w, other, share)
                p1, p2 = worlds.params[w, c], worlds.params[w, other]
                if rectangles_overlap(
                    x1, y1, yaw1, 0.5 * p1.length, 0.5 * p1.width,
                    x2, y2, yaw2, 0.5 * p2.length, 0.5 * p2.width,
                ):  # fmt: skip
                    impact = _relative_speed(worlds.state[w, c], worlds.state[w, other])
                    _park(worlds, w, c, x1, y1, yaw1, HIT_CAR, impact)
                    _park(worlds, w, other, x2, y2, yaw2, HIT_CAR, impact)


@njit(cache=True, error_model="numpy", forceinline=True)
def _between(worlds, w, c, share):
    """The pose of a car at a share of its last physics step."""
    state = worlds.state[w, c]
    x0, y0, yaw0 = worlds.before[w, c, 0], worlds.before[w, c, 1], worlds.before[w, c, 2]
    turn = wrap_angle(float(state[column.YAW] - yaw0))
    return (
        x0 + share * (state[column.X] - x0),
        y0 + share * (state[column.Y] - y0),
        yaw0 + share * turn,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _relative_speed(one, other):
    """Of two cars [m/s], from their states."""
    way1 = float(one[column.YAW] + one[column.SLIP])
    way2 = float(other[column.YAW] + other[column.SLIP])
    dx = one[column.SPEED] * math.cos(way1) - other[column.SPEED] * math.cos(way2)
    dy = one[column.SPEED] * math.sin(way1) - other[column.SPEED] * math.sin(way2)
    return math.sqrt(dx * dx + dy * dy)


@njit(cache=True, error_model="numpy", forceinline=True)
def _park(worlds, w, c, x, y, yaw, contact, impact_speed):
    """Stop a car where it made contact; a car that is parked already stays as it is."""
    if worlds.contact[w, c] != FREE:
        return
    state = worlds.state[w, c]
    worlds.contact[w, c] = contact
    worlds.impact_speed[w, c] = impact_speed
    steer = state[column.STEER]
    state[:] = 0.0
    state[column.X], state[column.Y], state[column.YAW] = x, y, wrap_angle(float(yaw))
    state[column.STEER] = steer
    worlds.before[w, c, 0], worlds.before[w, c, 1], worlds.before[w, c, 2] = x, y, state[column.YAW]
