"""Projection on a centreline, and back: one point, on a float32 table of the curve, from a starting guess.

Frenet coordinates: `s` [m] along the line from the start line, `d` [m] to its left. `table` holds rows of
`track.centerline.TABLE`, of many lines one after another: `row0` is the first row of this line, `rows` their number and
`h` the spacing [m]. Between rows the curve is the cubic Hermite segment of the two positions and tangents.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

_MAX_STEP = 2.0  # [m] a Newton step is cut to this
_MAX_ITERATIONS = 12
_TOLERANCE = 1e-3  # [m] a step this small is the last: Newton's next would be its square


@njit(cache=True, error_model="numpy", inline="always")
def _wrap(s, length):
    """`s` brought into [0, length); 0 for what is not finite."""
    if 0.0 <= s < length:  # nearly always, and a division cheaper
        return s
    s -= length * math.floor(s / length)
    return s if 0.0 <= s < length else 0.0


@njit(cache=True, error_model="numpy")
def frenet_project(table, row0, rows, h, x, y, s_guess):
    """The foot of the perpendicular from (x, y) [m] on the line near `s_guess` [m].

    Returns (s in [0, length), d, heading of the tangent there). Newton's method on
    (r(s) − p)·r'(s) = 0; outside the line's evolute it walks downhill instead. Finite for finite
    input; never reads outside the table.
    """
    length = rows * h
    inverse = 1.0 / h
    # A first step from the row before the guess, along its tangent and circle, mostly ends within a
    # centimetre and costs half of one on the curve.
    i = min(int(_wrap(float(s_guess), length) * inverse), rows - 1)
    a = table[row0 + i]
    away_x, away_y = x - a.x, y - a.y
    ax, ay = float(a.tangent_x), float(a.tangent_y)
    step = (away_x * ax + away_y * ay) / max(1.0 - a.curvature * (ax * away_y - ay * away_x), 0.2)
    s = _wrap(i * h + (step if -_MAX_STEP < step < _MAX_STEP else 0.0), length)
    velocity_x, velocity_y = 1.0, 0.0
    bend_x = bend_y = 0.0
    for _ in range(_MAX_ITERATIONS):
        scaled = s * inverse
        i = min(int(scaled), rows - 1)
        t = scaled - i
        a = table[row0 + i]
        b = table[row0 + (i + 1 if i + 1 < rows else 0)]
        chord_x = float(b.x) - float(a.x)
        chord_y = float(b.y) - float(a.y)
        ax, ay = h * a.tangent_x, h * a.tangent_y
        bx, by = h * b.tangent_x, h * b.tangent_y
        # r(t) = r_a + t·(a + t·(c2 + t·c3)), all derivatives with respect to t
        c3x, c3y = ax + bx - 2.0 * chord_x, ay + by - 2.0 * chord_y
        c2x, c2y = chord_x - ax - c3x, chord_y - ay - c3y
        away_x = a.x - x + t * (ax + t * (c2x + t * c3x))
        away_y = a.y - y + t * (ay + t * (c2y + t * c3y))
        velocity_x = ax + t * (2.0 * c2x + 3.0 * t * c3x)
        velocity_y = ay + t * (2.0 * c2y + 3.0 * t * c3y)
        bend_x = 2.0 * c2x + 6.0 * t * c3x
        bend_y = 2.0 * c2y + 6.0 * t * c3y
        squared = velocity_x * velocity_x + velocity_y * velocity_y
        slope = away_x * velocity_x + away_y * velocity_y
        second = squared + away_x * bend_x + away_y * bend_y
        floor = 0.05 * squared  # where distance is not convex, take a bounded step downhill
        step = -h * slope / (second if second > floor else max(-second, floor))
        if not (step >= -_MAX_STEP):
            step = -_MAX_STEP
        elif step > _MAX_STEP:
            step = _MAX_STEP
        s = _wrap(s + step, length)
        if -_TOLERANCE < step < _TOLERANCE:
            break
    # Carry the last evaluation over the last step.
    t = step * inverse
    if -1.0 < t < 1.0:
        away_x += t * (velocity_x + 0.5 * t * bend_x)
        away_y += t * (velocity_y + 0.5 * t * bend_y)
        velocity_x += t * bend_x
        velocity_y += t * bend_y
    norm = 1.0 / math.sqrt(velocity_x * velocity_x + velocity_y * velocity_y)
    d = (velocity_y * away_x - velocity_x * away_y) * norm
    return s, d, math.atan2(velocity_y, velocity_x)


@njit(cache=True, error_model="numpy")
def frenet_point(table, row0, rows, h, s, d):
    """The point `d` [m] left of the line at `s` [m]: (x, y, heading of the tangent)."""
    s = _wrap(float(s), rows * h)
    scaled = s / h
    i = min(int(scaled), rows - 1)
    t = scaled - i
    a = table[row0 + i]
    b = table[row0 + (i + 1 if i + 1 < rows else 0)]
    chord_x = float(b.x) - float(a.x)
    chord_y = float(b.y) - float(a.y)
    ax, ay = h * a.tangent_x, h * a.tangent_y
    bx, by = h * b.tangent_x, h * b.tangent_y
    c3x, c3y = ax + bx - 2.0 * chord_x, ay + by - 2.0 * chord_y
    c2x, c2y = chord_x - ax - c3x, chord_y - ay - c3y
    velocity_x = ax + t * (2.0 * c2x + 3.0 * t * c3x)
    velocity_y = ay + t * (2.0 * c2y + 3.0 * t * c3y)
    norm = d / math.sqrt(velocity_x * velocity_x + velocity_y * velocity_y)
    x = a.x + t * (ax + t * (c2x + t * c3x)) - norm * velocity_y
    y = a.y + t * (ay + t * (c2y + t * c3y)) + norm * velocity_x
    return x, y, math.atan2(velocity_y, velocity_x)
