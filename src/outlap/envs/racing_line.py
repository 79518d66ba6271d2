"""The line to race on each track, and the speed to have on it: the track's raceline, or else its centreline."""

from __future__ import annotations

import numpy as np

from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING, Atlas
from outlap.simulator.vehicle import A_MAX, MU, V_MAX
from outlap.track import centerline
from outlap.track.centerline import CURVATURE
from outlap.track.track import Track

GRAVITY = 9.81  # [m/s²]
LATERAL_SHARE = 0.8  # of the grip that a corner may ask for
LINE_X, LINE_Y, LINE_SPEED = range(3)  # columns


def racing_lines(tracks: tuple[Track, ...], atlas: Atlas, params: np.ndarray) -> np.ndarray:
    """The racing line beside every row of the atlas: float32 (rows, 3) x [m], y [m], speed [m/s].

    The track's raceline, with its speed column, at the arc lengths of the centreline beside which its points lie. A
    track without one gets the centreline, and the speed at which its curvature asks for LATERAL_SHARE of the grip,
    braking and accelerating within a_max.

    Args:
        params: (N_PARAMS,) of a typical car: its mu, a_max and v_max count where there is no raceline.
    """
    out = np.empty((len(atlas.line), 3), np.float32)
    for number, track in enumerate(tracks):
        first, rows = atlas.index[number, FIRST_ROW], atlas.index[number, ROWS]
        spacing, length = atlas.frame[number, SPACING], track.centerline.length
        here, line = out[first : first + rows], track.raceline
        if line is not None:
            at, _ = track.centerline.to_frenet(line.x, line.y)
            for column, values in ((LINE_X, line.x), (LINE_Y, line.y), (LINE_SPEED, line.speed)):
                here[:, column] = np.interp(np.arange(rows) * spacing, at, values, period=length)
        else:
            middle = atlas.line[first : first + rows]
            here[:, [LINE_X, LINE_Y]] = middle[:, [centerline.X, centerline.Y]]
            here[:, LINE_SPEED] = _friction_limited(middle[:, CURVATURE], spacing, params)
    return out


def _friction_limited(curvature: np.ndarray, spacing: float, params: np.ndarray) -> np.ndarray:
    """A speed profile around a closed line: cornering limit, then braking backwards and accelerating forwards."""
    lateral = LATERAL_SHARE * float(params[MU]) * GRAVITY
    squared = np.minimum(lateral / np.maximum(np.abs(curvature), 1e-6), float(params[V_MAX]) ** 2)
    gain = 2.0 * min(float(params[A_MAX]), lateral) * spacing
    for order in (range(2 * len(squared), 0, -1), range(2 * len(squared))):
        before = order[0] % len(squared)
        for index in order:
            i = index % len(squared)
            squared[i] = min(squared[i], squared[before] + gain)
            before = i
    return np.sqrt(squared)
