"""The line of least curvature: a sequence of quadratic programmes.

Source of the linearisation: A. Heilmeier et al., Minimum curvature trajectory planning and control for an autonomous
race car, Vehicle System Dynamics 58 (2020). Here every programme is about the line that the last one found, so that
offsets get small, and in its own Frenet frame: a line of curvature k, moved to its left by n(s), gets k + n'' + k² n.
"""

from __future__ import annotations

import casadi
import numpy as np
from scipy import ndimage

from outlap.errors import OutlapError
from outlap.planning.corridor import corridor
from outlap.planning.ipopt import QUIET, ended
from outlap.planning.limits import CarLimits
from outlap.planning.path import ClosedPath, path_along, path_through
from outlap.track.track import Track

SPACING = 0.25  # [m] of the points that move
SMOOTHING = 0.3  # [m] curvature that changes over less costs more than it saves: steering takes time
STEP = 0.5  # [m] that a point may move in one programme, and
TURN = 0.25  # the part of its radius of curvature: beyond, the linearisation means little
PROGRAMMES = 25
ENOUGH = 2e-3  # a smaller part of the cost is not worth another programme
OVERSTEP = 0.02  # [m] into the margin that the stairs of the map's pixels can ask back: not from a line that is there


def min_curvature(track: Track, limits: CarLimits, margin: float) -> ClosedPath:
    """The closed line of least ∫k² ds that a car can drive without coming nearer to a wall than the margin.

    Args:
        track: to plan on, from its start line.
        limits: of the car, of which its width counts.
        margin: to the walls, on either side of the car [m].

    Raises OutlapError where the track is narrower than the car and its margins, or the solver fails.
    """
    path = path_along(track.centerline, SPACING)
    radius = 0.5 * limits.width + margin
    right, left = corridor(track, path, radius)
    least, step = np.inf, STEP
    for _ in range(PROGRAMMES):
        moved = path_through(path.shifted(_least_curvature(track, path, right, left, step)), SPACING)
        cost = _cost(moved)
        if cost > least:  # too far for the linearisation
            step *= 0.4
            if step < OVERSTEP:
                break
            continue
        done = least - cost < ENOUGH * cost
        path, least = moved, cost
        if done:
            break
        right, left = corridor(track, path, radius)
    return path


def _least_curvature(track: Track, path: ClosedPath, right: np.ndarray, left: np.ndarray, step: float) -> np.ndarray:
    """The quadratic programme: offsets (n,) [m] between right and left, none beyond what a step may be."""
    n, h = len(path.points), path.spacing
    bend = ndimage.maximum_filter1d(np.abs(path.curvature), 2 * round(1.0 / h) + 1, mode="wrap")
    step_here = np.minimum(step, TURN * (step / STEP) / np.maximum(bend, 1e-6))
    low = np.where(np.abs(right) < OVERSTEP, np.minimum(right, 0.0), right)
    high = np.where(np.abs(left) < OVERSTEP, np.maximum(left, 0.0), left)
    low = np.minimum(np.maximum(low, -step_here), high)  # from where the car does not fit, the way back may be longer
    high = np.maximum(np.minimum(high, step_here), low)

    offset, curvature = casadi.MX.sym("offset", n), casadi.MX.sym("curvature", n)
    second = (_next(offset) - 2.0 * offset + _next(offset, -1)) / h**2
    change = (_next(curvature) - curvature) / h
    solver = casadi.nlpsol(
        "min_curvature",
        "ipopt",
        {
            "x": casadi.vertcat(offset, curvature),
            "f": h * casadi.sumsqr(curvature) + h * SMOOTHING**2 * casadi.sumsqr(change) + 1e-6 * casadi.sumsqr(offset),
            "g": path.curvature + second + path.curvature**2 * offset - curvature,
        },
        {
            "print_time": False,
            "ipopt": {**QUIET, "mehrotra_algorithm": "yes", "hessian_constant": "yes", "jac_c_constant": "yes"},
        },
    )  # fmt: skip
    free = np.full(n, np.inf)
    found = solver(
        x0=np.concatenate([np.clip(0.0, low, high), path.curvature]),
        lbx=np.concatenate([low, -free]), ubx=np.concatenate([high, free]), lbg=0.0, ubg=0.0,
    )  # fmt: skip
    if (failure := ended(solver)) is not None:
        worst = int(np.abs(np.asarray(found["g"]).ravel()).argmax())
        s = float(track.centerline.to_frenet(*path.points[worst])[0])
        raise OutlapError(
            f"track {track.name}: the quadratic programme for least curvature came to no line ({failure}); at "
            f"s = {s:.1f} m its curvature does not follow from its offsets; take another margin"
        )
    return np.clip(np.asarray(found["x"]).ravel()[:n], low, high)


def _next(column: casadi.MX, step: int = 1) -> casadi.MX:
    """The entries of a closed line's column (n,) moved up by a step of 1 or -1."""
    return casadi.vertcat(column[step:], column[:step])


def _cost(path: ClosedPath) -> float:
    return float(np.sum(path.curvature**2) * path.spacing)
