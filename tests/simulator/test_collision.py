"""Contact against clipped polygons, and at speed: none that is not there, none that is missed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from oracles import grid_to_world, overlap_area, overlaps_wall, rectangle_corners
from outlap.simulator.atlas import build_atlas
from outlap.simulator.collision import FREE, HIT_CAR, HIT_WALL, rectangles_overlap, touches_wall
from outlap.simulator.simulator import MODELS, Simulator
from outlap.simulator.state import SLIP, SPEED, STEER, YAW, X, Y
from outlap.track.track import Track
from synthetic_tracks import CAR, hall, place, random_map, yard

CAR_LENGTH, CAR_WIDTH = float(CAR["length"]), float(CAR["width"])
CLEARANCE = 0.03  # [m] at which a car may pass a wall


def in_contact(track: Track, x, y, yaw, length, width, atlas=None) -> bool:
    atlas = atlas or build_atlas([track])
    return touches_wall(atlas, np.int32(0), float(x), float(y), yaw, 0.5 * length, 0.5 * width)


def overlap(first, second) -> bool:
    """`rectangles_overlap` of two (x, y, yaw, length, width)."""
    (x1, y1, yaw1, length1, width1), (x2, y2, yaw2, length2, width2) = first, second
    return rectangles_overlap(x1, y1, yaw1, 0.5 * length1, 0.5 * width1, x2, y2, yaw2, 0.5 * length2, 0.5 * width2)


# Against the oracle


@pytest.mark.parametrize("seed", range(4))
def test_contact_with_walls_is_that_of_clipped_polygons(seed):
    rng = np.random.default_rng(seed)
    resolution = [0.05, 0.08, 0.1, 0.31][seed]
    track = hall(random_map(rng, 40, 50, 0.01), resolution, (*rng.uniform(-9.0, 9.0, 2), [0.0, 0.7, -2.0, 3.1][seed]))
    atlas = build_atlas([track])
    found = []
    for _ in range(250):
        x, y = grid_to_world(track, rng.uniform(-1.0, 51.0), rng.uniform(-1.0, 41.0))
        yaw, length, width = rng.uniform(-7.0, 7.0), rng.uniform(0.1, 0.7), rng.uniform(0.05, 0.5)
        found.append(in_contact(track, x, y, yaw, length, width, atlas))
        body = float(x), float(y), yaw, length, width
        assert found[-1] == overlaps_wall(track.occupancy, resolution, track.origin, body), body
    assert 0.1 < np.mean(found) < 0.9


@pytest.mark.parametrize("yaw", [0.0, 0.9])
def test_what_lies_outside_the_map_is_wall(yaw):
    track = hall(np.zeros((40, 60), bool), 0.05, (1.0, 2.0, yaw))  # 3 m × 2 m
    for u, v, expected in [
        (1.5, 1.0, False), (0.301, 1.0, False), (0.299, 1.0, True), (2.699, 1.0, False), (2.701, 1.0, True),
        (1.5, 0.101, False), (1.5, 0.099, True), (1.5, 1.899, False), (1.5, 1.901, True),
        (-0.1, 1.0, True), (-50.0, 1.0, True), (1.5, 1e7, True), (3.0, 2.0, True),
    ]:  # fmt: skip
        x, y = grid_to_world(track, u / 0.05, v / 0.05)
        assert in_contact(track, x, y, yaw, 0.6, 0.2) == expected, (u, v)


def test_a_body_larger_than_any_clearance_that_is_stored_touches_a_far_wall():
    occupancy = np.zeros((201, 201), bool)
    occupancy[100, 171] = True  # its near edge is 70.5 cells from the middle
    track = hall(occupancy, 0.05)
    x, y = grid_to_world(track, 100.5, 100.5)
    assert in_contact(track, x, y, 0.0, 141.2 * 0.05, 0.2)
    assert not in_contact(track, x, y, 0.0, 140.8 * 0.05, 0.2)
    assert not in_contact(track, x, y, 0.5, 141.2 * 0.05, 0.2)


def test_contact_of_rectangles_is_that_of_clipped_polygons():
    rng = np.random.default_rng(1)
    found = []
    for _ in range(1500):
        first = (*rng.uniform(-0.5, 0.5, 2), rng.uniform(-7.0, 7.0), *rng.uniform(0.1, 1.0, 2))
        second = (*rng.uniform(-0.5, 0.5, 2), rng.uniform(-7.0, 7.0), *rng.uniform(0.1, 1.0, 2))
        area = overlap_area(rectangle_corners(*first), rectangle_corners(*second))
        if 0.0 < area < 1e-9:
            continue
        found.append(overlap(first, second))
        assert found[-1] == (area > 0.0), (first, second)
        assert overlap(second, first) == found[-1]
    assert 0.2 < np.mean(found) < 0.8


def test_rectangles_that_cross_or_contain_one_another_overlap():
    cross = (0.0, 0.0, 0.3, 2.0, 0.1), (0.0, 0.0, 0.3 + math.pi / 2, 2.0, 0.1)
    inside = (0.0, 0.0, 0.0, 2.0, 2.0), (0.3, 0.2, 1.0, 0.2, 0.1)
    for first, second in (cross, inside):
        assert overlap(first, second)
        assert overlap(second, first)


def test_rectangles_a_hair_apart_do_not_overlap():
    corner_to_side = 0.5 * math.hypot(0.6, 0.3)
    turned = math.pi / 2 - math.atan2(0.3, 0.6)  # the diagonal along y
    for gap, expected in ((1e-6, False), (-1e-6, True)):
        assert overlap((0, 0, 0.0, 0.6, 0.3), (0.6 + gap, 0.1, math.pi, 0.6, 0.3)) == expected
        assert overlap((0, 0, 0.0, 0.6, 0.3), (0.1, 0.3 + gap, 0.0, 0.6, 0.3)) == expected
        above = 0.15 + corner_to_side + gap
        assert overlap((0, 0, 0.0, 0.6, 0.3), (0.0, above, turned, 0.6, 0.3)) == expected


# No contact that is not there


def slanted_wall(slant: float, yaw: float) -> tuple[Track, np.ndarray]:
    """A hall, left of a line through its middle all wall; the pose [m, m, rad] of that line's middle.

    A cell is wall if all of its square is left of the line, so that no wall is right of it.
    """
    cells, resolution = 440, 0.05
    rows, cols = np.indices((cells, cells)) - cells // 2
    heights = [math.cos(slant) * (rows + up) - math.sin(slant) * (cols + right) for up in (0, 1) for right in (0, 1)]
    track = hall(np.min(heights, axis=0) >= 0.0, resolution, (-7.0, 4.0, yaw))
    x, y = grid_to_world(track, cells / 2, cells / 2)
    return track, np.array([x, y, yaw + slant])


def beside(line: np.ndarray, along: float, left: float, yaw: float) -> list[float]:
    """A pose relative to that of a line."""
    x, y, heading = line
    cos, sin = math.cos(heading), math.sin(heading)
    return [x + cos * along - sin * left, y + sin * along + cos * left, heading + yaw]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("timestep", [0.01, 0.05])
def test_no_contact_3_cm_from_a_wall_at_any_speed_and_heading_along_it(model, timestep):
    slants_and_yaws = [(0.0, 0.0), (0.0, 1.9), (0.3, -0.8), (0.7, 0.2), (-1.2, 3.0)]
    walls = [slanted_wall(*pair) for pair in slants_and_yaws]
    speeds = [1.0, 3.0, 7.0, 12.0, 20.0]
    left = -(0.5 * CAR_WIDTH + CLEARANCE)
    poses, which, speed = [], [], []
    for number, (_, line) in enumerate(walls):
        for v in speeds:
            poses += [[beside(line, -9.0, left, 0.0)], [beside(line, 9.0, left, math.pi)]]
            which += [number, number]
            speed += [[v], [v]]
    tracks = [track for track, _ in walls]
    sim = place(tracks, poses, speed=speed, which_track=which, model=model, timestep=timestep, beams=0)
    commands = np.stack([np.zeros_like(speed), np.array(speed)], axis=-1)
    steps = round(0.9 / timestep)
    for _ in range(steps):
        sim.step(commands)
        assert not sim.worlds.contact.any(), np.argwhere(sim.worlds.contact)[:, 0]
    # They drove all the way, and as near as they were meant to.
    for w, (pose, number) in enumerate(zip(poses, which, strict=True)):
        x, y, yaw = sim.worlds.state[w, 0, [X, Y, YAW]].astype(float)
        driven = math.hypot(x - pose[0][0], y - pose[0][1])
        assert driven == pytest.approx(0.9 * speed[w][0], abs=0.05)
        line = walls[number][1]
        normal = -math.sin(line[2]), math.cos(line[2])
        corners = rectangle_corners(x, y, yaw, CAR_LENGTH, CAR_WIDTH)
        nearest = max(normal[0] * (px - line[0]) + normal[1] * (py - line[1]) for px, py in corners)
        assert nearest == pytest.approx(-CLEARANCE, abs=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 2.2])
def test_contact_begins_where_the_wall_does(yaw):
    track, line = slanted_wall(0.0, yaw)
    poses = [[beside(line, 1.0, -0.5 * CAR_WIDTH - gap, 0.0)] for gap in (1e-3, -1e-3)]
    sim = place(track, poses, speed=5.0, beams=0)
    assert sim.worlds.contact[:, 0].tolist() == [FREE, HIT_WALL]


def test_a_car_that_leans_on_a_pixelated_wall_touches_it():
    for slant in (0.3, 0.7, -1.2):
        track, line = slanted_wall(slant, 0.4)
        # The staircase is nowhere more than a cell's diagonal behind the line.
        poses = [[beside(line, -2.0, -0.5 * CAR_WIDTH + 0.0708, 0.0)]]
        assert place(track, poses, beams=0).worlds.contact[0, 0] == HIT_WALL


# None that is missed


def drive(sim: Simulator, seconds: float, speed) -> None:
    """Straight on at a target speed, broadcast to (worlds, cars)."""
    worlds, cars = sim.worlds.contact.shape
    commands = np.zeros((worlds, cars, 2))
    commands[..., 1] = speed
    for _ in range(math.ceil(seconds / sim.config.timestep)):
        sim.step(commands)


def body(sim: Simulator, world: int, car: int = 0) -> tuple[float, ...]:
    """Pose, length and width of a car."""
    x, y, yaw = sim.worlds.state[world, car, [X, Y, YAW]].astype(float).tolist()
    return x, y, yaw, *sim.worlds.params[world, car][["length", "width"]].item()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("timestep", [0.01, 0.05, 0.1])
def test_a_wall_one_pixel_thick_stops_a_car_at_20_metres_a_second(model, timestep):
    occupancy = np.zeros((80, 400), bool)
    occupancy[:, 200] = True  # 10.00 to 10.05 m; the map's edge is at 20 m
    track = hall(occupancy, 0.05)
    start = np.random.default_rng(0).uniform(6.0, 8.0, 60)
    sim = place(track, [[[x, 2.0, 0.0]] for x in start], speed=20.0, model=model, timestep=timestep, beams=0)
    drive(sim, 0.25, 20.0)
    assert (sim.worlds.contact == HIT_WALL).all()
    np.testing.assert_allclose(sim.worlds.impact_speed, 20.0, rtol=0.02 if model == "drift" else 1e-6)
    inside = sim.worlds.state[:, 0, X] + 0.5 * CAR_LENGTH - 10.0
    assert inside.min() >= 0.0
    assert inside.max() <= 0.5 * CAR_WIDTH + 1e-4  # found soon enough, however long the step


@pytest.mark.parametrize("timestep", [0.01, 0.05])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_wall_one_pixel_thick_stops_a_car_that_slides_into_it_sideways(timestep, side):
    occupancy = np.zeros((160, 240), bool)
    occupancy[[80]] = True  # 4.00 to 4.05 m
    track = hall(occupancy, 0.05)
    wall = 4.0 if side > 0.0 else 4.05
    gap = np.random.default_rng(0).uniform(0.001, 15.0 * timestep, 60)
    y = wall - side * (0.5 * CAR_WIDTH + gap)
    sim = place(track, [[[6.0, v, 0.0]] for v in y], speed=20.0, timestep=timestep, beams=0)
    sim.worlds.state[..., SLIP] = side * 0.5 * math.pi  # the velocity points across
    drive(sim, timestep, 20.0)
    assert (sim.worlds.contact == HIT_WALL).all()
    for world in range(len(y)):
        assert overlaps_wall(track.occupancy, track.resolution, track.origin, body(sim, world))
    # Parked before its middle, and so its scanner, is in the wall or beyond it.
    assert (side * (wall - sim.worlds.state[:, 0, Y]) >= -1e-5).all()


def test_a_body_wider_than_long_stops_with_its_middle_before_the_wall():
    occupancy = np.zeros((200, 200), bool)
    occupancy[:, 150:] = True
    params = CAR.copy()
    params["length"], params["width"] = 0.05, 1.0
    poses = [[[6.0 + 0.007 * k, 5.0, 0.0]] for k in range(60)]
    sim = place(hall(occupancy), poses, speed=20.0, params=params, beams=0)
    drive(sim, 0.2, 20.0)
    assert (sim.worlds.contact == HIT_WALL).all()
    assert (sim.worlds.state[..., X] < 7.5).all()


@pytest.mark.parametrize("timestep", [0.01, 0.05])
def test_a_single_pixel_stops_a_car(timestep):
    occupancy = np.zeros((80, 400), bool)
    occupancy[40, 200] = True
    track = hall(occupancy, 0.05)
    rng = np.random.default_rng(0)
    # The pixel reaches from y = 2.00 to 2.05 m.
    poses = np.zeros((60, 1, 3))
    poses[:, 0, 0] = rng.uniform(6.0, 8.0, 60)
    poses[:, 0, 1] = 2.0 + rng.uniform(-0.5 * CAR_WIDTH + 0.001, 0.5 * CAR_WIDTH + 0.049, 60)
    sim = place(track, poses, speed=20.0, timestep=timestep, beams=0)
    drive(sim, 0.25, 20.0)
    assert (sim.worlds.contact == HIT_WALL).all()
    assert (sim.worlds.state[:, 0, X] < 10.0).all()


def test_a_wall_is_met_in_reverse_and_while_turning():
    occupancy = np.zeros((80, 200), bool)
    occupancy[:, 100] = True  # 5.00 to 5.05 m
    track = hall(occupancy, 0.05)
    sim = place(track, [[[6.0, 2.0, 0.0]], [[3.5, 2.0, 0.0]]], speed=[[-4.0], [6.0]], beams=0)
    for _ in range(100):
        sim.step(np.array([[[0.4, -4.0]], [[0.4, 6.0]]]))
    assert (sim.worlds.contact == HIT_WALL).all()
    for world in range(2):
        assert overlaps_wall(track.occupancy, track.resolution, track.origin, body(sim, world))


# Cars


@pytest.mark.parametrize("timestep", [0.01, 0.05, 0.1])
@pytest.mark.parametrize("offset", [0.0, 0.3])  # [m] of their lines; they are 0.31 m wide
def test_cars_that_meet_head_on_at_20_metres_a_second_each_do_not_pass_through_one_another(timestep, offset):
    gap = np.random.default_rng(0).uniform(2.0, 8.0, 60)
    poses = [[[-0.5 * g, 0.0, 0.0], [0.5 * g, offset, math.pi]] for g in gap]
    sim = place(yard(24.0), poses, speed=20.0, timestep=timestep, beams=0)
    drive(sim, 0.3, 20.0)
    assert (sim.worlds.contact == HIT_CAR).all()
    np.testing.assert_allclose(sim.worlds.impact_speed, 40.0, rtol=1e-6)  # between the two
    assert (sim.worlds.state[:, 0, X] < sim.worlds.state[:, 1, X]).all()
    for world in range(len(gap)):
        assert overlap(body(sim, world, 0), body(sim, world, 1))


@pytest.mark.parametrize("timestep", [0.01, 0.05])
def test_cars_that_meet_at_a_crossing_touch(timestep):
    rng = np.random.default_rng(0)
    away = rng.uniform(2.0, 6.0, 60)
    early = rng.uniform(-0.3, 0.3, 60)
    poses = [[[-a, 0.0, 0.0], [0.0, -a - e, 0.5 * math.pi]] for a, e in zip(away, early, strict=True)]
    sim = place(yard(24.0), poses, speed=20.0, timestep=timestep, beams=0)
    drive(sim, 0.35, 20.0)
    assert (sim.worlds.contact == HIT_CAR).all()


def test_cars_pass_2_cm_apart_without_contact():
    lane = CAR_WIDTH + 0.02
    poses = [[[-8.0, 0.0, 0.0], [8.0, lane, math.pi], [-8.0, -lane, 0.0]] for _ in range(4)]
    speed = np.array([[20.0, 20.0, 20.0], [20.0, 5.0, 10.0], [3.0, 20.0, 19.0], [12.0, 12.0, 7.0]])
    sim = place(yard(24.0), poses, speed=speed, beams=0)
    drive(sim, 0.8, speed)
    assert not sim.worlds.contact.any()
    assert (sim.worlds.state[:, 0, X] > sim.worlds.state[:, 1, X])[:3].all()


def test_what_stands_in_contact_at_the_start_is_in_contact():
    poses = [[[0.0, 0.0, 0.0], [0.3, 0.2, 1.0], [5.0, 0.0, 0.0], [11.9, 0.0, 0.0]]]
    sim = place(yard(24.0), poses, speed=[[1.0, 2.0, 3.0, 4.0]], beams=0)
    assert sim.worlds.contact[0].tolist() == [HIT_CAR, HIT_CAR, FREE, HIT_WALL]
    between = math.hypot(1.0 - 2.0 * math.cos(1.0), 2.0 * math.sin(1.0))  # of the two velocities
    np.testing.assert_allclose(sim.worlds.impact_speed[0], [between, between, 0.0, 4.0], rtol=1e-5)


# After contact


def test_impact_speed_is_that_of_the_same_car_without_the_wall():
    occupancy = np.zeros((80, 400), bool)
    free = hall(occupancy, 0.05)
    occupancy[:, 200] = True
    walled = hall(occupancy, 0.05)
    sim = place([walled, free], [[[6.0, 2.0, 0.0]]] * 2, speed=2.0, which_track=[0, 1], beams=0)
    for _ in range(200):
        sim.step(np.tile([0.0, 20.0], (2, 1, 1)))
        if sim.worlds.contact[0, 0]:
            break
    assert sim.worlds.contact[:, 0].tolist() == [HIT_WALL, FREE]
    assert sim.worlds.impact_speed[0, 0] == sim.worlds.state[1, 0, SPEED] > 5.0


def test_a_car_in_contact_is_parked_where_it_touched_and_stays():
    occupancy = np.zeros((80, 200), bool)
    occupancy[:, 100] = True
    track = hall(occupancy, 0.05)
    sim = place(track, [[[3.0, 2.0, 0.0]]], speed=10.0, beams=9, field_of_view=3.0)
    sim.step(np.array([[[0.1, 10.0]]]), repeats=50)
    assert sim.worlds.contact[0, 0] == HIT_WALL
    parked, impact = sim.worlds.state.copy(), sim.worlds.impact_speed.copy()
    moving = np.delete(parked[0, 0], [X, Y, YAW, STEER])
    np.testing.assert_array_equal(moving, 0.0)
    scan, distance = sim.worlds.scan.copy(), sim.worlds.distance.copy()
    for steer, speed in [(0.4, 20.0), (-0.4, -5.0)]:
        for _ in range(20):
            sim.step(np.array([[[steer, speed]]]))
        np.testing.assert_array_equal(sim.worlds.state, parked)
        np.testing.assert_array_equal(sim.worlds.impact_speed, impact)
        np.testing.assert_array_equal(sim.worlds.scan, scan)
        np.testing.assert_allclose(sim.worlds.distance, distance, atol=1e-6)
        assert sim.worlds.contact[0, 0] == HIT_WALL
    assert sim.worlds.time[0] == pytest.approx(0.9)


def test_cars_that_crash_do_not_disturb_the_others():
    crash = [[-3.0, 0.0, 0.0], [3.0, 0.0, math.pi]]
    other = [0.0, 5.0, -2.0]
    together = place(yard(24.0), [[*crash, other]], speed=[[20.0, 20.0, 6.0]], beams=0)
    alone = place(yard(24.0), [[other]], speed=6.0, beams=0)
    for k in range(60):
        command = [0.2 * math.sin(0.1 * k), 6.0 + 0.02 * k]
        together.step(np.array([[[0.0, 20.0], [0.0, 20.0], command]]))
        alone.step(np.array([[command]]))
        np.testing.assert_array_equal(together.worlds.state[0, 2], alone.worlds.state[0, 0])
    assert together.worlds.contact[0].tolist() == [HIT_CAR, HIT_CAR, FREE]


def test_a_parked_car_is_still_there_to_be_hit():
    poses = [[[11.0, 0.0, 0.0], [6.0, 0.0, 0.0]]]
    sim = place(yard(24.0), poses, speed=[[10.0, 10.0]], beams=0)
    drive(sim, 1.0, 10.0)
    assert sim.worlds.contact[0].tolist() == [HIT_WALL, HIT_CAR]
    assert overlap(body(sim, 0, 0), body(sim, 0, 1))


def test_contact_is_forgotten_at_the_next_reset():
    sim = place(yard(24.0), [[[11.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]], speed=10.0, beams=0)
    drive(sim, 0.2, 10.0)
    assert sim.worlds.contact[:, 0].tolist() == [HIT_WALL, FREE]
    world = np.array([0])
    starts = np.array([[[1.0, 0.0, 0.0, 3.0]]])
    sim.reset(world, keys=world, tracks=world, params=sim.worlds.params[:1].copy(), starts=starts)
    assert sim.worlds.contact[0, 0] == FREE
    assert sim.worlds.impact_speed[0, 0] == 0.0
    drive(sim, 0.2, 3.0)
    assert sim.worlds.state[0, 0, SPEED] == 3.0
