"""Walls drawn from a centreline and its widths."""

# SciPy has no type stubs:
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from outlap.errors import OutlapError
from outlap.track.centerline import Centerline

MAX_PIXELS = 100_000_000
_MAX_SAMPLES = 10_000_000
_BLOCK = 16  # pixels along the side of the blocks that are ruled out as one


def draw_walls(
    centerline: Centerline, resolution: float, margin: float
) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Rasterise the drivable band: (occupancy (height, width) bool, row 0 at the bottom; origin (x, y, 0)).

    A pixel is free if its centre is no further from the nearest point of the centreline than the
    width there, on its side; all others are wall. `margin` [m] of wall surrounds the band.
    Raises OutlapError for a resolution that is not positive or gives over 100 million pixels.
    """
    if not (math.isfinite(resolution) and resolution > 0.0):
        raise OutlapError(f"resolution is {resolution}; it must be a positive number of metres per pixel")
    if not (math.isfinite(margin) and margin >= 0.0):
        raise OutlapError(f"margin is {margin}; it must be zero or more metres")
    # Half a pixel between samples: the line bends so little in between that its tangent is exact enough.
    count = math.ceil(2.0 * centerline.length / resolution)
    if count > _MAX_SAMPLES:
        raise OutlapError(
            f"resolution is {resolution}; the line is {centerline.length / resolution:.3g} pixels long "
            f"and may be {_MAX_SAMPLES // 2_000_000} million, take a coarser one"
        )
    s = np.arange(count) * (centerline.length / count)
    line = centerline.position(s)
    heading = centerline.heading(s)
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    right, left = centerline.widths(s)
    reach = float(max(right.max(), left.max()))

    low = line.min(axis=0) - reach - margin - resolution
    width, height = (math.ceil(side / resolution) for side in line.max(axis=0) + reach + margin - low + resolution)
    if width * height > MAX_PIXELS:
        raise OutlapError(
            f"resolution is {resolution}; it makes {width} x {height} pixels and there may be "
            f"{MAX_PIXELS // 1_000_000} million, take a coarser one"
        )

    tree = KDTree(line)
    rows, cols = _near_pixels(tree, low, (height, width), resolution, reach)
    centres = np.stack([low[0] + (cols + 0.5) * resolution, low[1] + (rows + 0.5) * resolution], axis=1)
    # No free pixel is further away than that: the bound only cuts the search short.
    nearest = cast("NDArray[np.intp]", tree.query(centres, distance_upper_bound=reach + resolution)[1])
    found = nearest < count
    rows, cols, centres, nearest = rows[found], cols[found], centres[found], nearest[found]
    away = centres - line[nearest]
    along = tangent[nearest]
    d = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
    free = (d <= left[nearest]) & (-d <= right[nearest])

    occupancy = np.ones((height, width), dtype=bool)
    occupancy[rows[free], cols[free]] = False
    return occupancy, (float(low[0]), float(low[1]), 0.0)


def _near_pixels(
    tree: KDTree, low: np.ndarray, shape: tuple[int, int], resolution: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels in all blocks that come within `reach` [m] of the line."""
    height, width = shape
    block_row, block_col = np.indices((-(-height // _BLOCK), -(-width // _BLOCK)))
    size = _BLOCK * resolution
    centre = np.stack([low[0] + (block_col + 0.5) * size, low[1] + (block_row + 0.5) * size], axis=-1)
    limit = reach + size / math.sqrt(2.0) + resolution
    distance = cast("NDArray[np.float64]", tree.query(centre.reshape(-1, 2), distance_upper_bound=limit)[0])
    near = np.flatnonzero(np.isfinite(distance))
    inner_row, inner_col = np.indices((_BLOCK, _BLOCK))
    rows = (block_row.ravel()[near, None] * _BLOCK + inner_row.ravel()).ravel()
    cols = (block_col.ravel()[near, None] * _BLOCK + inner_col.ravel()).ravel()
    inside = (rows < height) & (cols < width)
    return rows[inside], cols[inside]
