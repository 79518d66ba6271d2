"""The packed grids against the tracks that they were packed from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.simulator.atlas import (
    FIRST_ROW,
    FIRST_WORD,
    GRID_HEIGHT,
    GRID_WIDTH,
    RING,
    ROWS,
    SPACING,
    WALL,
    build_atlas,
    cell_clearance,
    to_grid,
)
from outlap.track.track import Track
from synthetic_tracks import hall, random_map, ring


def unpack(atlas, number: int) -> np.ndarray:
    """Clearance or WALL of every cell of a track's grid, the ring included."""
    first, width, height = atlas.index[number, [FIRST_WORD, GRID_WIDTH, GRID_HEIGHT]]
    return np.array(
        [[cell_clearance(atlas.words, first, width, col, row) for col in range(width)] for row in range(height)]
    )


def clearance(occupancy: np.ndarray) -> np.ndarray:
    """Distance from each cell's square to the nearest wall square [cells], by trying them all."""
    rows, cols = np.nonzero(np.pad(occupancy, 1, constant_values=True))
    height, width = occupancy.shape
    row, col = np.indices((height, width))
    down = np.maximum(np.abs(row[..., None] - (rows - 1)) - 1, 0)
    across = np.maximum(np.abs(col[..., None] - (cols - 1)) - 1, 0)
    return np.sqrt(np.min(down**2 + across**2, axis=-1))


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    """Grids whose sides are and are not multiples of what a word holds, turned in every direction."""
    rng = np.random.default_rng(0)
    shapes = [(14, 22), (13, 21), (1, 1), (31, 17), (40, 9)]
    return [
        hall(random_map(rng, *shape, 0.03), resolution, (*rng.uniform(-5.0, 5.0, 2), yaw))
        for shape, resolution, yaw in zip(
            shapes, [0.05, 0.1, 0.0325, 0.08, 1.0], [0.0, 0.4, -3.0, 2.0, 1.2], strict=True
        )
    ]


def test_every_cell_of_every_track_is_a_wall_or_says_how_far_a_ray_can_go(tracks):
    atlas = build_atlas(tracks)
    for number, track in enumerate(tracks):
        cells = unpack(atlas, number)
        inner = cells[RING:-RING, RING:-RING]
        np.testing.assert_array_equal(inner == WALL, track.occupancy)
        exact = clearance(track.occupancy)[~track.occupancy]
        # More, and a ray would pass through a wall; less, and it would only take longer.
        np.testing.assert_array_equal(inner[~track.occupancy], np.minimum(np.floor(exact), WALL - 1))


def test_a_ring_of_wall_surrounds_every_grid(tracks):
    atlas = build_atlas(tracks)
    for number in range(len(tracks)):
        cells = unpack(atlas, number)
        assert (cells[[0, -1]] == WALL).all()
        assert (cells[:, [0, -1]] == WALL).all()


def test_clearance_that_four_bits_cannot_hold_is_cut():
    cells = unpack(build_atlas([hall(np.zeros((151, 160), bool))]), 0)
    assert cells[RING + 75, RING + 80] == WALL - 1
    assert cells[RING + 75, RING + 10] == 10
    assert (cells[RING:-RING, RING:-RING] != WALL).all()


def test_points_fall_into_the_cells_that_the_track_says(tracks):
    atlas = build_atlas(tracks)
    rng = np.random.default_rng(1)
    for number, track in enumerate(tracks):
        for x, y in rng.uniform(-8.0, 8.0, (20, 2)):
            expected = np.add(track.world_to_grid(x, y), RING)
            np.testing.assert_allclose(to_grid(atlas.frame, number, x, y), expected, atol=1e-9)


def test_the_centrelines_lie_one_after_another_with_their_own_spacing():
    tracks = [ring(3.0), ring(5.0), ring(4.01)]
    atlas = build_atlas(tracks)
    for number, track in enumerate(tracks):
        first, rows = atlas.index[number, [FIRST_ROW, ROWS]]
        assert rows * atlas.frame[number, SPACING] == pytest.approx(track.centerline.length, rel=1e-12)
        assert atlas.frame[number, SPACING] == pytest.approx(0.1, rel=0.01)
        angle = 2.0 * math.pi * np.arange(rows) / rows
        radius = float(track.name.removeprefix("ring"))
        expected = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        np.testing.assert_allclose(
            np.stack([atlas.line[name][first : first + rows] for name in "xy"], axis=-1), expected, atol=1e-5
        )
    assert atlas.index[:, ROWS].sum() == len(atlas.line)
