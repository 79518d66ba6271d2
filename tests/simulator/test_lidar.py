"""Ranges against exact rays on wall squares and car bodies; sensor errors against their distributions."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy import stats

from oracles import cast_rays_at_rectangle, cast_rays_at_walls, grid_to_world
from outlap.simulator.atlas import build_atlas
from outlap.simulator.lidar import beam_directions, cast_walls
from outlap.track.catalog import load_track
from outlap.track.track import Track
from synthetic_tracks import CAR, hall, place, random_map, ring, yard

ACCURACY = 1e-3  # [m]
# A ray that grazes a wall's corner may take it or miss it: as if walls were this much larger or smaller.
GRAZING = 5e-3  # [cells]
# How many rays of a map full of corners that may be. The worst is a stair of cells that touch only at their
# corners, 1.4 cells apart as seen by a ray across it: what comes within 0.0014 cells of one may slip through.
GRAZING_SHARE = 2e-3


def beam_angles(beams: int, field_of_view: float) -> np.ndarray:
    return np.linspace(-0.5, 0.5, beams) * field_of_view if beams != 1 else np.zeros(1)


@cache
def atlas_of(track: Track):
    return build_atlas([track])


def cast(track: Track, x, y, yaw, beams: int, field_of_view: float, max_range: float) -> np.ndarray:
    """Ranges to the walls of a track, from a pose of the scanner: (beams,) [m]."""
    ranges = np.full(beams, np.nan, np.float32)
    cast_walls(atlas_of(track), 0, x, y, yaw, *beam_directions(beams, field_of_view), max_range, ranges)
    return ranges


def grazes(track: Track, ranges: np.ndarray, x, y, angles, max_range) -> np.ndarray:
    """Which rays differ from the exact range; fails where even a grazed corner does not explain it."""

    def exact(grow):
        return cast_rays_at_walls(track.occupancy, track.resolution, track.origin, x, y, angles, max_range, grow)

    assert np.all((ranges >= 0.0) & (ranges <= np.float32(max_range)))
    off = np.abs(ranges - exact(0.0)) > ACCURACY
    if off.any():
        nearest, farthest = exact(GRAZING), exact(-GRAZING)
        explained = (ranges >= nearest - ACCURACY) & (ranges <= farthest + ACCURACY)
        assert explained[off].all(), f"from ({x}, {y}) at {angles[~explained]}: {ranges[~explained]}"
    return off


@pytest.mark.parametrize("beams", [1, 31, 32, 33, 108, 540, 1080])
def test_ranges_are_exact_on_random_maps_from_random_poses(beams):
    rng = np.random.default_rng(beams)
    grazed = []
    for _ in range(8):
        resolution = rng.choice([0.02, 0.05, 0.1])
        origin = (*rng.uniform(-20.0, 20.0, 2), rng.uniform(-math.pi, math.pi))
        track = hall(random_map(rng, 45, 70, rng.choice([0.002, 0.02, 0.2])), resolution, origin)
        for _ in range(max(1, 128 // beams)):
            x, y = map(float, grid_to_world(track, rng.uniform(0.0, 70.0), rng.uniform(0.0, 45.0)))
            yaw, field_of_view = rng.uniform(-10.0, 10.0), rng.uniform(0.5, 2.0 * math.pi)
            max_range = rng.choice([0.3, 2.0, 30.0])
            ranges = cast(track, x, y, yaw, beams, field_of_view, max_range)
            grazed.append(grazes(track, ranges, x, y, yaw + beam_angles(beams, field_of_view), max_range))
    assert np.concatenate(grazed).mean() <= GRAZING_SHARE


def test_no_beams_is_an_empty_scan():
    assert cast(ring(), 8.0, 0.0, 0.0, 0, 4.7, 30.0).shape == (0,)


def test_beams_run_from_right_to_left_over_the_whole_field_of_view():
    cos, sin = beam_directions(5, math.pi)
    expected = np.radians([-90.0, -45.0, 0.0, 45.0, 90.0])
    np.testing.assert_allclose(np.arctan2(sin, cos)[:5], expected, atol=1e-7)
    track = hall(np.zeros((40, 80), bool), 0.1)  # 8 m × 4 m
    np.testing.assert_allclose(cast(track, 3.0, 1.0, 0.0, 3, math.pi, 30.0), [1.0, 5.0, 3.0], atol=ACCURACY)
    np.testing.assert_allclose(cast(track, 3.0, 1.0, 0.0, 1, 4.7, 30.0), [5.0], atol=ACCURACY)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_the_edge_of_the_map_is_a_wall(yaw):
    rng = np.random.default_rng(1)
    track = hall(np.zeros((64, 63), bool), 0.05, (3.0, -2.0, yaw))  # 64: whole tiles, but for the ring
    for col, row in [(0.001, 0.001), (62.999, 63.999), *rng.uniform(0.0, 63.0, (6, 2))]:
        x, y = map(float, grid_to_world(track, col, row))
        angles = yaw + beam_angles(540, 2.0 * math.pi)
        ranges = cast(track, x, y, yaw, 540, 2.0 * math.pi, 30.0)
        assert not grazes(track, ranges, x, y, angles, 30.0).any()


def test_a_scanner_in_a_wall_or_off_the_map_reads_zero():
    occupancy = np.zeros((40, 40), bool)
    occupancy[10:20, 10:20] = True
    track = hall(occupancy, 0.1)
    for x, y in [(1.5, 1.5), (1.001, 1.999), (-3.0, 2.0), (2.0, 50.0), (1e6, -1e6)]:
        assert not cast(track, x, y, 0.3, 108, 6.0, 30.0).any()


def test_rays_along_the_lines_of_the_grid_and_through_its_corners():
    rng = np.random.default_rng(6)
    tested = 0
    for yaw in (0.0, 0.5 * math.pi, 0.3):
        track = hall(random_map(rng, 30, 40, 0.03), 0.05, (1.0, 2.0, yaw))
        places = rng.integers(1, 30, (40, 2)).astype(float)
        places[::2, 0] += 0.5
        for col, row in places:
            # On a wall's own edge it is anyone's guess whether the scanner is inside.
            if track.occupancy[int(row) - 1 : int(row) + 1, int(col - 0.5) : int(col) + 1].any():
                continue
            x, y = map(float, grid_to_world(track, col, row))
            ranges = cast(track, x, y, yaw, 17, 2.0 * math.pi, 30.0)  # every 22.5 degrees
            grazes(track, ranges, x, y, yaw + beam_angles(17, 2.0 * math.pi), 30.0)
            tested += 1
    assert tested > 60


def test_ranges_stay_exact_over_thousands_of_cells():
    occupancy = np.zeros((60, 7000), bool)
    occupancy[::7, ::97] = True
    track = hall(occupancy, 0.05, (-200.0, 30.0, 0.2))
    rng = np.random.default_rng(7)
    for col in (20.0, 3490.0, 6980.0):
        for _ in range(8):
            x, y = map(float, grid_to_world(track, col, rng.uniform(1.0, 59.0)))
            angles = 0.2 + np.array([0.0, math.pi])[:, None] + beam_angles(33, 0.05)
            for side in angles:
                ranges = cast(track, x, y, side[16], 33, 0.05, 400.0)
                off = grazes(track, ranges, x, y, side, 400.0)
                assert off.sum() <= 1


def test_every_track_of_an_atlas_is_cast_as_if_alone():
    rng = np.random.default_rng(8)
    tracks = [
        hall(random_map(rng, *shape, 0.02), resolution, (0.0, 0.0, yaw))
        for shape, resolution, yaw in [((31, 50), 0.1, 0.0), ((64, 17), 0.05, 1.0), ((45, 45), 0.08, -2.0)]
    ]
    together, directions = build_atlas(tracks), beam_directions(108, 6.0)
    for number, track in enumerate(tracks):
        x, y = map(float, grid_to_world(track, 8.3, 20.2))
        ranges = np.empty(108, np.float32)
        cast_walls(together, number, x, y, 0.4, *directions, 30.0, ranges)
        np.testing.assert_array_equal(ranges, cast(track, x, y, 0.4, 108, 6.0, 30.0))
        assert ranges.max() > 0.3


def test_a_stair_of_cells_that_touch_at_corners_stops_all_but_grazing_rays():
    occupancy = np.eye(60, dtype=bool)
    track = hall(occupancy, 0.05)
    rng = np.random.default_rng(2)
    grazed = []
    for _ in range(20):
        row = rng.uniform(0.5, 20.0)
        x, y = map(float, grid_to_world(track, row + rng.uniform(15.0, 38.0), row))
        angles = 2.356 + beam_angles(540, 1.5)
        grazed.append(grazes(track, cast(track, x, y, 2.356, 540, 1.5, 30.0), x, y, angles, 30.0))
    assert np.concatenate(grazed).mean() <= GRAZING_SHARE


@pytest.mark.parametrize("name", ["IMS", "Spielberg"])
def test_ranges_are_exact_on_real_circuits(real_tracks, name):
    track = load_track(real_tracks / name)
    atlas = build_atlas([track])
    rng = np.random.default_rng(3)
    beams, max_range = 108, 30.0
    directions, angles = beam_directions(beams, 4.7), beam_angles(beams, 4.7)
    ranges = np.empty(beams, np.float32)
    grazed = []
    for s in rng.uniform(0.0, track.centerline.length, 15):
        x, y = map(float, track.centerline.to_cartesian(s, rng.uniform(-0.7, 0.7)))
        yaw = float(track.centerline.heading(s)) + rng.normal(0.0, 0.5)
        cast_walls(atlas, 0, x, y, yaw, *directions, max_range, ranges)
        grazed.append(grazes(track, ranges, x, y, yaw + angles, max_range))
        assert 0.2 < np.median(ranges) < 20.0
    assert np.concatenate(grazed).mean() <= GRAZING_SHARE


# Through the simulator: mount, range and the other cars


@pytest.mark.parametrize("mount_x", [0.0, 0.275, -0.1])
def test_the_scanner_sits_in_front_of_the_centre_of_gravity_and_moves_with_the_car(mount_x):
    rng = np.random.default_rng(4)
    track = hall(random_map(rng, 200, 200, 0.002), 0.1, (-10.0, -10.0, 0.0))
    params = CAR.copy()
    params["mount_x"] = mount_x
    poses = np.concatenate([rng.uniform(-8.0, 8.0, (6, 1, 2)), rng.uniform(-3.0, 3.0, (6, 1, 1))], axis=-1)
    sim = place(track, poses, params=params, beams=54, field_of_view=4.7)
    grazed = []
    for _ in range(2):
        for world in range(6):
            x, y, yaw = sim.worlds.state[world, 0, [0, 1, 4]].astype(float)
            scanner = x + mount_x * math.cos(yaw), y + mount_x * math.sin(yaw)
            angles = yaw + beam_angles(54, 4.7)
            grazed.append(grazes(track, sim.worlds.scan[world, 0], *scanner, angles, 30.0))
        sim.step(np.tile([0.3, 4.0], (6, 1, 1)), repeats=30)
    assert np.concatenate(grazed).mean() <= GRAZING_SHARE


def test_beams_that_meet_nothing_read_the_maximum_range_of_their_car():
    params = np.full((1, 3), CAR)
    params["max_range"][0] = [2.0, 7.5, 100.0]
    sim = place(
        yard(),
        [[[0.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, -8.0, 0.0]]],
        params=params,
        beams=3,
        field_of_view=0.5,
    )
    np.testing.assert_array_equal(sim.worlds.scan[0, 0], np.float32(2.0))
    np.testing.assert_array_equal(sim.worlds.scan[0, 1], np.float32(7.5))
    expected = 20.0 / np.cos([0.25, 0.0, 0.25])
    np.testing.assert_allclose(sim.worlds.scan[0, 2], expected, atol=ACCURACY)


def test_cars_are_seen_where_they_are_nearer_than_the_wall_and_never_by_themselves():
    rng = np.random.default_rng(5)
    track = hall(random_map(rng, 240, 240, 0.001), 0.1, (-12.0, -12.0, 0.0))
    worlds, cars, beams = 12, 4, 135
    poses = np.concatenate(
        [rng.uniform(-4.0, 4.0, (worlds, cars, 2)), rng.uniform(-3.0, 3.0, (worlds, cars, 1))], axis=-1
    )
    params = np.full((worlds, cars), CAR)
    params["width"] = rng.uniform(0.2, 0.8, (worlds, cars))
    params["length"] = rng.uniform(0.3, 1.5, (worlds, cars))
    params["mount_x"] = rng.uniform(-0.2, 0.3, (worlds, cars))
    params["max_range"] = rng.choice([3.0, 10.0], (worlds, cars))
    sim = place(track, poses, params=params, beams=beams, field_of_view=2.0 * math.pi)
    grazed, cars_seen = [], 0
    for w in range(worlds):
        # Cars that start in contact stay where they are: every pose counts.
        bodies = [
            (*map(float, sim.worlds.state[w, c, [0, 1, 4]]), *params[w, c][["length", "width"]].item())
            for c in range(cars)
        ]
        for c in range(cars):
            x, y, yaw = bodies[c][:3]
            x += float(params["mount_x"][w, c]) * math.cos(yaw)
            y += float(params["mount_x"][w, c]) * math.sin(yaw)
            angles, max_range = yaw + beam_angles(beams, 2.0 * math.pi), float(params["max_range"][w, c])
            to_wall = cast_rays_at_walls(track.occupancy, track.resolution, track.origin, x, y, angles, max_range)
            to_cars = np.min([cast_rays_at_rectangle(x, y, angles, bodies[o]) for o in range(cars) if o != c], axis=0)
            cars_seen += np.count_nonzero(to_cars < to_wall)
            exact = np.minimum(to_wall, to_cars)
            grazed.append(np.abs(sim.worlds.scan[w, c] - exact) > ACCURACY)
    assert cars_seen > 500
    assert np.concatenate(grazed).mean() <= 1e-3


def test_a_car_is_seen_from_inside_its_body_and_at_the_end_of_the_range():
    params = np.full((1, 2), CAR)
    params["max_range"][0, 0] = 3.0
    sim = place(yard(), [[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]], params=params, beams=9, field_of_view=6.0)
    assert not sim.worlds.scan[0, 0].any()
    rear = 3.0 - 0.01  # the other car's rear end, a centimetre within the range
    sim = place(yard(), [[[0.0, 0.0, 0.0], [rear + 0.29, 0.0, 0.0]]], params=params, beams=1)
    np.testing.assert_allclose(sim.worlds.scan[0, 0], rear, atol=1e-4)
    sim = place(yard(), [[[0.0, 0.0, 0.0], [rear + 0.29 + 0.02, 0.0, 0.0]]], params=params, beams=1)
    np.testing.assert_array_equal(sim.worlds.scan[0, 0], np.float32(3.0))


def test_the_scan_after_a_step_is_of_the_poses_after_the_step():
    sim = place(yard(), [[[0.0, 0.0, 0.0], [5.0, 0.0, math.pi]]], beams=1)
    sim.step(np.array([[[0.0, 3.0], [0.0, 1.0]]]), repeats=50)
    state = sim.worlds.state[0]
    gap = float(state[1, 0] - state[0, 0]) - 0.29
    assert gap < 4.0
    np.testing.assert_allclose(sim.worlds.scan[0, :, 0], gap, atol=1e-3)


# What is wrong with the ranges


def noisy(worlds=6, cars=2, beams=101, steps=40, keys=None, **errors) -> tuple[np.ndarray, np.ndarray]:
    """Scans of cars at rest, and the exact ones: (steps, worlds, cars, beams), (cars, beams)."""
    track = yard(30.0)  # smaller than the default range: every beam meets something
    poses = np.tile([[0.0, 0.0, 0.3], [0.0, 8.0, 0.3]][:cars], (worlds, 1, 1))
    params = CAR.copy()
    clean = place(track, poses[:1], params=params, beams=beams).worlds.scan[0].copy()
    assert clean.max() < 30.0
    for name, value in errors.items():
        params[name] = value
    keys = np.arange(1, worlds + 1) if keys is None else keys
    sim = place(track, poses, params=params, keys=keys, beams=beams)
    scans = [sim.worlds.scan.copy()]
    for _ in range(steps - 1):
        sim.step(np.zeros((worlds, cars, 2)))
        scans.append(sim.worlds.scan.copy())
    return np.array(scans), clean


def test_without_errors_the_scan_is_exact_at_every_step():
    scans, clean = noisy(steps=3)
    np.testing.assert_array_equal(scans, np.broadcast_to(clean, scans.shape))


def test_noise_is_gaussian_with_the_given_spread():
    scans, clean = noisy(noise_std=0.05)
    z = ((scans - clean) / 0.05).ravel()
    n = z.size
    assert n > 40_000
    assert abs(z.mean()) < 4.0 / math.sqrt(n)
    assert abs(z.std() - 1.0) < 4.0 / math.sqrt(2.0 * n)
    assert stats.kstest(z, "norm").pvalue > 1e-3


def test_noise_is_independent_across_beams_cars_worlds_and_steps():
    scans, clean = noisy(noise_std=0.05)
    z = (scans - clean) / 0.05  # (steps, worlds, cars, beams)
    for axis in range(4):
        for lag in range(1, min(4, z.shape[axis])):
            count = z.shape[axis] - lag
            first, second = np.take(z, range(count), axis), np.take(z, range(lag, count + lag), axis)
            assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 4.5 / math.sqrt(first.size)
    # The same beam of another car, and of the next step, is another draw, not the same numbers moved along.
    numbers = np.round(z, 3)
    assert np.mean(numbers[:, :, 0] == numbers[:, :, 1]) < 0.01
    assert np.mean(numbers[1:, ..., :-1] == numbers[:-1, ..., 1:]) < 0.01


def test_noise_repeats_with_the_key_and_only_with_the_key():
    first, _ = noisy(keys=[5, 6, 5, 2**63 + 5, 0, 1], noise_std=0.02, steps=4)
    again, _ = noisy(keys=[5, 6, 5, 2**63 + 5, 0, 1], noise_std=0.02, steps=4)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[:, 0], first[:, 2])
    for world in (1, 3, 4, 5):
        assert np.mean(first[:, 0] == first[:, world]) < 0.02


def test_bias_is_added_to_ranges_that_met_something():
    scans, clean = noisy(bias=-0.3, steps=1)
    np.testing.assert_allclose(scans, np.broadcast_to(clean - 0.3, scans.shape), atol=1e-5)
    scans, clean = noisy(bias=0.3, max_range=14.0, steps=1)
    expected = np.where(clean < 14.0, np.minimum(clean + 0.3, 14.0), 14.0)
    assert (clean > 14.0).any()
    assert (clean < 14.0).any()
    np.testing.assert_allclose(scans, np.broadcast_to(expected, scans.shape), atol=1e-5)


@pytest.mark.parametrize("rate", [0.001, 0.25, 1.0])
def test_dropout_happens_at_its_rate_and_reads_the_maximum_range(rate):
    scans, clean = noisy(dropout=rate, max_range=100.0)
    dropped = scans == np.float32(100.0)
    np.testing.assert_array_equal(scans[~dropped], np.broadcast_to(clean, scans.shape)[~dropped])
    n = dropped.size
    assert abs(dropped.mean() - rate) <= 4.0 * math.sqrt(rate * (1.0 - rate) / n)
    for axis in range(4):  # one beam's does not tell of its neighbour's
        count = dropped.shape[axis] - 1
        both = np.take(dropped, range(count), axis) & np.take(dropped, range(1, count + 1), axis)
        assert abs(both.mean() - rate**2) <= 5.0 * math.sqrt(rate**2 * (1.0 - rate**2) / both.size) + 1e-12


def test_dropout_does_not_depend_on_the_noise_of_the_same_beam():
    scans, clean = noisy(noise_std=0.05, dropout=0.5, max_range=100.0)
    kept = scans < 100.0
    z = ((scans - clean) / 0.05)[kept]
    assert abs(z.mean()) < 4.0 / math.sqrt(z.size)
    assert abs(z.std() - 1.0) < 4.0 / math.sqrt(2.0 * z.size)


def test_ranges_stay_between_zero_and_the_maximum_whatever_the_errors():
    scans, clean = noisy(noise_std=15.0, bias=-2.0, dropout=0.1, max_range=18.0)
    assert scans.min() == 0.0
    assert scans.max() == np.float32(18.0)
    nothing = np.broadcast_to(clean >= 18.0, scans.shape)
    assert nothing.any()
    np.testing.assert_array_equal(scans[nothing], np.float32(18.0))
