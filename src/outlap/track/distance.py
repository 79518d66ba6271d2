"""The exact Euclidean distance transform of a grid, in two linear passes.

P. Felzenszwalb, D. Huttenlocher, Distance Transforms of Sampled Functions, Theory of Computing 8
(2012), section 2. In whole numbers until the final square root, so the result is exact. SciPy's
transform gives the same numbers in four times the time, which ten circuits of four million cells feel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray


def wall_distance(occupancy: np.ndarray, resolution: float) -> np.ndarray:
    """The distance from each cell's square to the nearest wall square: (height, width) float32 [m].

    0 for a cell that touches a wall, at a corner too, and -1 in a wall. What lies outside the grid is
    wall. `occupancy` (height, width) bool, True = wall; `resolution` [m/pixel].
    """
    # Two squares are as far apart as the centre of the one and the centres of the other and its eight
    # neighbours: so the walls grow by one cell, and centres are measured.
    wide = occupancy.copy()
    wide[:, 1:] |= occupancy[:, :-1]
    wide[:, :-1] |= occupancy[:, 1:]
    wide[:, [0, -1]] = True
    grown = wide.copy()
    grown[1:] |= wide[:-1]
    grown[:-1] |= wide[1:]
    grown[[0, -1]] = True
    field = _centre_distance(grown, resolution)
    field[occupancy] = -1.0
    return field


@njit(cache=True)
def _centre_distance(grown: NDArray[np.bool_], resolution: float) -> NDArray[np.float32]:
    """Distance between each cell's centre and the nearest True cell's; the grid's border is True."""
    height, width = grown.shape
    vertical = np.zeros((height, width), dtype=np.int32)  # cells to the nearest True one in the column
    for row in range(1, height):
        for col in range(width):
            vertical[row, col] = 0 if grown[row, col] else vertical[row - 1, col] + 1
    for row in range(height - 2, -1, -1):
        for col in range(width):
            vertical[row, col] = min(vertical[row, col], vertical[row + 1, col] + 1)

    out = np.empty((height, width), dtype=np.float32)
    apex = np.empty(width, dtype=np.int64)  # columns of the parabolas of the lower envelope
    start = np.empty(width + 1, dtype=np.int64)  # first column that each of them rules
    for row in range(height):
        last = 0
        apex[0] = 0
        start[0] = 0
        for col in range(1, width):
            f = np.int64(vertical[row, col]) ** 2 + col * col
            while True:
                other = apex[last]
                g = np.int64(vertical[row, other]) ** 2 + other * other
                # the first whole column where the new parabola is not above the old one
                meet = -((g - f) // (2 * (col - other)))
                if meet > start[last] or last == 0:
                    break
                last -= 1
            if meet <= start[last]:
                apex[last] = col  # it rules from the first column on
            elif meet < width:
                last += 1
                apex[last] = col
                start[last] = meet
        start[last + 1] = width
        for k in range(last + 1):
            for col in range(start[k], start[k + 1]):
                across = np.int64(col - apex[k])
                squared = across * across + np.int64(vertical[row, apex[k]]) ** 2
                out[row, col] = math.sqrt(squared) * resolution
    return out
