"""Contact of a car's true rectangle with walls and with other cars, by separating axes."""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

from outlap.simulator.atlas import (
    COS,
    FIRST_WORD,
    GRID_HEIGHT,
    GRID_WIDTH,
    RESOLUTION,
    SIN,
    WALL,
    cell_clearance,
    to_grid,
)

FREE, HIT_WALL, HIT_CAR, REMOVED = range(4)  # REMOVED: a car that was taken off the track


@njit(cache=True, error_model="numpy")
def touches_wall(atlas, track, x, y, yaw, half_length, half_width):
    """Whether a rectangle overlaps a wall cell's square; what lies outside the map is wall.

    Args:
        atlas, track: the tracks and the number of this one.
        x, y, yaw: pose of the rectangle's centre [m, m, rad].
        half_length, half_width: [m].
    """
    index = atlas.index[track]
    width, height = index[GRID_WIDTH], index[GRID_HEIGHT]
    col, row = to_grid(atlas.frame, track, x, y)
    if not (1.0 <= col < width - 1.0 and 1.0 <= row < height - 1.0):
        return True
    per_metre = 1.0 / atlas.frame[track, RESOLUTION]
    a = half_length * per_metre
    b = half_width * per_metre
    clearance = cell_clearance(atlas.words, index[FIRST_WORD], width, int(col), int(row))
    if clearance != WALL and clearance * clearance > a * a + b * b:
        return False

    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    cos = cos_yaw * atlas.frame[track, COS] + sin_yaw * atlas.frame[track, SIN]
    sin = sin_yaw * atlas.frame[track, COS] - cos_yaw * atlas.frame[track, SIN]
    abs_cos = abs(cos)
    abs_sin = abs(sin)
    # The grid's axes: only cells within the rectangle's bounding box can overlap it.
    reach_x = a * abs_cos + b * abs_sin
    reach_y = a * abs_sin + b * abs_cos
    first_col, last_col = int(max(col - reach_x, 0.0)), int(min(col + reach_x, width - 1.0))
    first_row, last_row = int(max(row - reach_y, 0.0)), int(min(row + reach_y, height - 1.0))
    # The rectangle's axes: half of its extent and of the cell's, projected.
    along = a + 0.5 * (abs_cos + abs_sin)
    across = b + 0.5 * (abs_cos + abs_sin)
    for j in range(first_row, last_row + 1):
        dy = j + 0.5 - row
        for i in range(first_col, last_col + 1):
            dx = i + 0.5 - col
            if abs(cos * dx + sin * dy) >= along or abs(cos * dy - sin * dx) >= across:
                continue
            if cell_clearance(atlas.words, index[FIRST_WORD], width, i, j) == WALL:
                return True
    return False


@njit(cache=True, error_model="numpy")
def rectangles_overlap(x1, y1, yaw1, length1, width1, x2, y2, yaw2, length2, width2):
    """Whether two rectangles overlap: poses of their centres [m, m, rad], half lengths and half widths [m]."""
    dx = x2 - x1
    dy = y2 - y1
    if dx * dx + dy * dy >= (length1 + width1 + length2 + width2) ** 2:
        return False
    cos1, sin1 = math.cos(yaw1), math.sin(yaw1)
    cos2, sin2 = math.cos(yaw2), math.sin(yaw2)
    cos = abs(cos1 * cos2 + sin1 * sin2)
    sin = abs(sin1 * cos2 - cos1 * sin2)
    if abs(cos1 * dx + sin1 * dy) >= length1 + length2 * cos + width2 * sin:
        return False
    if abs(cos1 * dy - sin1 * dx) >= width1 + length2 * sin + width2 * cos:
        return False
    if abs(cos2 * dx + sin2 * dy) >= length2 + length1 * cos + width1 * sin:
        return False
    return abs(cos2 * dy - sin2 * dx) < width2 + length1 * sin + width1 * cos
