"""Track: grid and world, walls, the distance field against brute force, and how a track is found."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from oracles import grid_to_world
from outlap.errors import OutlapError
from outlap.track import Centerline, Track, catalog, load_track
from outlap.track.map_io import write_track


def ring(yaw: float = 0.0, occupancy: np.ndarray | None = None) -> Track:
    """A track of 60 x 40 cells of 0.25 m, free inside its border."""
    if occupancy is None:
        occupancy = np.zeros((40, 60), dtype=bool)
        occupancy[[0, -1]] = True
        occupancy[:, [0, -1]] = True
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    line = Centerline.from_points(np.column_stack([4.5 + 3.0 * np.cos(angle), 7.0 + 2.0 * np.sin(angle)]), 1.0, 1.0)
    return Track("ring", occupancy, 0.25, (-3.0, 2.0, yaw), line)


def brute_force_distance(occupancy: np.ndarray, resolution: float) -> np.ndarray:
    """Square by square: the gap between each cell and every wall cell, a ring of outside cells included."""
    walls = np.pad(occupancy, 1, constant_values=True)
    wall_rows, wall_cols = np.nonzero(walls)
    field = np.empty(occupancy.shape)
    for row in range(occupancy.shape[0]):
        for col in range(occupancy.shape[1]):
            gap_y = np.maximum(np.abs(wall_rows - 1 - row) - 1, 0)
            gap_x = np.maximum(np.abs(wall_cols - 1 - col) - 1, 0)
            nearest = np.sqrt(np.min(gap_x**2 + gap_y**2)) * resolution
            field[row, col] = -1.0 if occupancy[row, col] else nearest
    return field


@pytest.mark.parametrize("density", [0.0, 0.003, 0.02, 0.3, 1.0])
@pytest.mark.parametrize("shape", [(31, 47), (40, 9), (1, 12), (12, 1), (2, 2)])
def test_distance_field_is_the_gap_between_squares(density: float, shape: tuple[int, int]) -> None:
    occupancy = np.random.default_rng(8).random(shape) < density
    track = ring(occupancy=occupancy)
    field = track.distance_field
    assert field.dtype == np.float32
    np.testing.assert_allclose(field, brute_force_distance(occupancy, 0.25), rtol=1e-6)
    assert np.all((field < 0.0) == occupancy)


def test_distance_field_is_a_safe_step_from_anywhere_in_a_cell() -> None:
    rng = np.random.default_rng(9)
    track = ring(yaw=0.4, occupancy=rng.random((40, 60)) < 0.01)
    col, row = rng.uniform(0.0, 60.0, 4000), rng.uniform(0.0, 40.0, 4000)
    step = track.distance_field[row.astype(int), col.astype(int)]
    x, y = grid_to_world(track, col, row)
    free = step >= 0.0
    angle = rng.uniform(0.0, 2.0 * np.pi, 4000)
    for part in (0.3, 0.7, 0.999):
        hit = track.is_wall(x + part * step * np.cos(angle), y + part * step * np.sin(angle))
        assert not np.any(hit[free])


def test_grid_and_world_honour_origin_and_yaw() -> None:
    track = ring(yaw=math.pi / 2.0)
    # turned a quarter left about (-3, 2): columns run up, rows run left
    np.testing.assert_allclose(grid_to_world(track, 4.0, 0.0), (-3.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(grid_to_world(track, 0.0, 4.0), (-4.0, 2.0), atol=1e-12)
    turned = ring(yaw=0.7)
    col, row = np.random.default_rng(10).uniform(-5.0, 70.0, (2, 100))
    np.testing.assert_allclose(turned.world_to_grid(*grid_to_world(turned, col, row)), (col, row), atol=1e-9)


def test_is_wall_reads_the_pixel_and_calls_the_outside_wall() -> None:
    occupancy = np.zeros((40, 60), dtype=bool)
    occupancy[5, 7] = True
    track = ring(occupancy=occupancy)
    x, y = grid_to_world(track, [7.01, 7.99, 6.99, 8.01, 7.5, 7.5], [5.01, 5.99, 5.5, 5.5, 4.99, 6.01])
    assert track.is_wall(x, y).tolist() == [True, True, False, False, False, False]
    x, y = grid_to_world(track, [-0.01, 60.01, 30.0, 30.0, 1e9], [20.0, 20.0, -0.01, 40.01, 1.0])
    assert np.all(track.is_wall(x, y))
    assert track.is_wall(np.nan, 0.0)


def test_a_track_cannot_be_changed() -> None:
    occupancy = np.zeros((40, 60), dtype=bool)
    track = ring(occupancy=occupancy)
    occupancy[3, 3] = True
    assert not track.occupancy[3, 3]
    for array in (track.occupancy, track.distance_field, track.centerline.points, track.centerline.s):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(AttributeError):
        track.name = "other"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("resolution", 0.0, "resolution is 0.0; it must be a positive"),
        ("resolution", math.nan, "resolution is nan"),
        ("occupancy", np.zeros(3, bool), r"occupancy has shape \(3,\)"),
        ("origin", (0.0, math.inf, 0.0), "origin is .*; it must be"),
    ],
)
def test_bad_fields_are_named(field: str, value: object, message: str) -> None:
    good = ring()
    fields = {"occupancy": good.occupancy, "resolution": 0.25, "origin": good.origin} | {field: value}
    with pytest.raises(OutlapError, match=message):
        Track(name="ring", centerline=good.centerline, **fields)  # type: ignore[arg-type]


def test_load_takes_a_folder_first_and_a_name_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalog, "find_track", lambda name: f"track {name}")
    monkeypatch.chdir(tmp_path)
    write_track(ring(), tmp_path / "ring")
    (tmp_path / "oval").mkdir()  # a folder of results, say: no map in it
    assert load_track("ring").name == "ring"
    assert load_track(tmp_path / "ring").name == "ring"
    assert load_track("elsewhere") == "track elsewhere"
    assert load_track("oval") == "track oval"
    with pytest.raises(OutlapError, match="oval: has no yaml file"):
        load_track("./oval")
    with pytest.raises(OutlapError, match=r"nowhere/ring: does not exist; give a map folder"):
        load_track("nowhere/ring")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(OutlapError, match="is neither a map folder nor"):
        load_track(tmp_path / "notes.txt")


def test_real_circuits_have_their_walls_and_a_clear_centreline(real_tracks: Path) -> None:
    track = load_track(real_tracks / "IMS")
    s = np.linspace(0.0, track.centerline.length, 500)
    assert not np.any(track.is_wall(*track.centerline.position(s).T))
    # walls 2.20 m apart: each is found within 1.1 m and a pixel or two of the line, everywhere
    for side in (-1.0, 1.0):
        d = side * np.linspace(0.7, 1.4, 60)
        points = track.centerline.to_cartesian(s[:, None], d)
        hits = track.is_wall(points[..., 0], points[..., 1])
        assert np.all(hits.any(axis=1))
    col, row = track.world_to_grid(*track.centerline.position(s).T)
    distance = track.distance_field[row.astype(int), col.astype(int)]
    assert np.all((distance > 0.7) & (distance < 1.2))


def test_the_fingerprint_tells_two_versions_of_a_map_apart() -> None:
    track = ring()
    assert track.fingerprint == ring().fingerprint
    walls = track.occupancy.copy()
    walls[20, 5] = True
    others = [ring(occupancy=walls), ring(yaw=0.1), replace(track, resolution=0.5), track.reversed()]
    assert len({track.fingerprint, *(other.fingerprint for other in others)}) == 5
