"""Tracks, packed into the flat arrays that the kernels read.

Walls and clearance are four bits a cell: 15 in a wall, otherwise how many cells a ray can safely go from anywhere
in the cell, rounded down and 14 at most. Eight cells, one above the other, make a word: that is what processors
gather. A cache line then holds 16 × 8 cells: what the scans of 256 worlds touch nearly fits the caches of two
cores, and waiting for memory would cost more than the rounding does. Every grid has a ring of wall cells, so that
no ray needs a bounds test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from outlap.track.track import Track

STACK = 8  # cells in a word, one above the other
RING = 1  # wall cells around the grid
WALL = 15  # in place of a wall cell's clearance
ROUNDING = np.float32(1e-4)  # [cells] that a whole clearance may lack for float32's sake
LINE_SPACING = 0.1  # [m] between rows of a centreline's table

# Columns of Atlas.frame
ORIGIN_X, ORIGIN_Y, COS, SIN, RESOLUTION, SPACING = range(6)
# Columns of Atlas.index
FIRST_WORD, GRID_WIDTH, GRID_HEIGHT, FIRST_ROW, ROWS = range(5)


class Atlas(NamedTuple):
    """All tracks of a simulator."""

    words: np.ndarray  # uint32: WALL or clearance of all grids' cells, eight a word
    line: np.ndarray  # track.centerline.TABLE (rows,): the centreline tables of all tracks
    index: np.ndarray  # int64 (tracks, 5): where each track lies in those  # pyright: ignore[reportIncompatibleMethodOverride]
    frame: np.ndarray  # float64 (tracks, 6): grid origin [m] and yaw, cell size and row spacing [m]


def build_atlas(tracks: Sequence[Track]) -> Atlas:
    """Pack tracks; the position of a track in `tracks` is its number in the kernels."""
    words: list[np.ndarray] = []
    lines: list[np.ndarray] = []
    index = np.zeros((len(tracks), 5), dtype=np.int64)
    frame = np.zeros((len(tracks), 6))
    first_word = first_row = 0
    for number, track in enumerate(tracks):
        cells = _pack_cells(track)
        line = track.centerline.table(LINE_SPACING)
        height, width = track.occupancy.shape
        index[number] = first_word, width + 2 * RING, height + 2 * RING, first_row, len(line)
        yaw = track.origin[2]
        frame[number] = (
            track.origin[0], track.origin[1], math.cos(yaw), math.sin(yaw),
            track.resolution, track.centerline.length / len(line),
        )  # fmt: skip
        first_word += len(cells)
        first_row += len(line)
        words.append(cells)
        lines.append(line)
    return Atlas(np.concatenate(words), np.concatenate(lines), index, frame)


def _pack_cells(track: Track) -> np.ndarray:
    """The words of a track's grid, row of words by row of words: uint32 (n,)."""
    clearance = np.minimum(track.distance_field / np.float32(track.resolution) + ROUNDING, WALL - 1)
    clearance = np.where(track.occupancy, WALL, clearance.astype(np.int32))
    height, width = clearance.shape
    down = -(-(height + 2 * RING) // STACK)
    cells = np.full((down * STACK, width + 2 * RING), WALL, dtype=np.uint32)
    cells[RING : RING + height, RING : RING + width] = clearance
    stacks = cells.reshape(down, STACK, -1)
    shifts = 4 * np.arange(STACK, dtype=np.uint32)[:, None]
    return np.bitwise_or.reduce(stacks << shifts, axis=1).reshape(-1)


@njit(cache=True)
def cell_clearance(words: np.ndarray, first_word: int, grid_width: int, col: int, row: int) -> np.int64:
    """The clearance of a cell [cells], or WALL; `col` and `row` count the ring and lie in the grid."""
    word = words[first_word + (row >> 3) * grid_width + col]
    return (np.int64(word) >> ((row & 7) << 2)) & 15


@njit(cache=True)
def to_grid(frame: np.ndarray, track: int, x: float, y: float) -> tuple[float, float]:
    """Map frame [m] → (column, row) of a track's grid [cells], the ring counted."""
    x = x - frame[track, ORIGIN_X]
    y = y - frame[track, ORIGIN_Y]
    cos = frame[track, COS]
    sin = frame[track, SIN]
    per_metre = 1.0 / frame[track, RESOLUTION]
    return (cos * x + sin * y) * per_metre + RING, (cos * y - sin * x) * per_metre + RING
