"""Where episodes begin: never in contact, and as StartConfig says."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from outlap.envs.keywords import make_race_vector
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError
from outlap.track.centerline import Centerline
from outlap.track.track import Track
from outlap.track.walls import draw_walls


def sizes_of(params: np.ndarray) -> np.ndarray:
    """Length and width of cars (...): (..., 2) [m]."""
    return np.stack([params["length"], params["width"]], axis=-1).astype(float)


def corners(pose: np.ndarray, length: float, width: float) -> np.ndarray:
    """Of a car's rectangle: (4, 2) [m]."""
    x, y, yaw = pose
    along = 0.5 * length * np.array([np.cos(yaw), np.sin(yaw)])
    across = 0.5 * width * np.array([-np.sin(yaw), np.cos(yaw)])
    return np.array([x, y]) + np.array([along + across, along - across, -along - across, across - along])


def apart(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two convex shapes are separated: some edge normal of either has one on each side."""
    for shape in (a, b):
        for edge in shape - np.roll(shape, 1, axis=0):
            normal = np.array([-edge[1], edge[0]])
            if max(a @ normal) < min(b @ normal) or max(b @ normal) < min(a @ normal):
                return True
    return False


def starts(env: RaceVectorEnv, resets: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses and sizes of many starts: (resets, worlds, cars, 3) and (..., 2)."""
    poses, sizes = [], []
    for reset in range(resets):
        env.reset(seed=0) if reset == 0 else env.reset()
        assert not env.race.worlds.contact.any()
        poses.append(env.race.worlds.state[..., [0, 1, 4]].astype(float))
        sizes.append(sizes_of(env.race.worlds.params))
    return np.stack(poses), np.stack(sizes)


@pytest.mark.parametrize("cars", [1, 2, 3, 4])
def test_no_start_touches_anything(ellipse, circle, cars):
    """Large cars of many sizes with wild headings: checked here with rectangles and the map's pixels."""
    env = make_race_vector(
        50, tracks=[ellipse, circle], num_cars=cars, beams=0, vehicle={"length": (0.4, 0.8), "width": (0.25, 0.45)},
        start={"offset": 1.0, "heading_error": 1.2, "gap": (0.0, 2.0)},
    )  # fmt: skip
    for reset in range(6):
        env.reset(seed=reset)
        assert not env.race.worlds.contact.any()
        for world in range(50):
            track = env.race.simulator.tracks[env.race.worlds.track[world]]
            poses = env.race.worlds.state[world][:, [0, 1, 4]].astype(float)
            sizes = sizes_of(env.race.worlds.params[world])
            bodies = [corners(pose, *size) for pose, size in zip(poses, sizes, strict=True)]
            for body in bodies:
                edge = np.concatenate([np.linspace(a, b, 9) for a, b in zip(body, np.roll(body, 1, 0), strict=True)])
                assert not track.is_wall(*edge.T).any()
            assert all(apart(a, b) for a, b in combinations(bodies, 2))


def test_nobody_touches_anything_in_the_first_step(ellipse, circle):
    env = make_race_vector(100, tracks=[ellipse, circle], num_cars=4, beams=0, opponent_speed=0.0)
    env.reset(seed=1)
    terminated = env.step(np.tile([0.0, -0.6], (100, 1)))[2]
    assert not terminated.any()
    assert not env.race.worlds.contact.any()


def test_anywhere_is_uniform_along_the_line(ellipse):
    env = make_race_vector(300, tracks=[ellipse], beams=0)
    poses, _ = starts(env, 3)
    s, _ = ellipse.centerline.to_frenet(poses[..., 0].ravel(), poses[..., 1].ravel())
    assert stats.kstest(s, "uniform", args=(0.0, ellipse.centerline.length)).pvalue > 1e-5


def test_otherwise_the_ego_stands_on_the_start_line(ellipse):
    env = make_race_vector(100, tracks=[ellipse], num_cars=3, beams=0, start={"anywhere": False})
    poses, _ = starts(env, 2)
    s, _ = ellipse.centerline.to_frenet(poses[..., 0, 0].ravel(), poses[..., 0, 1].ravel())
    np.testing.assert_allclose(np.minimum(s, ellipse.centerline.length - s), 0.0, atol=1e-3)
    others = env.race.worlds.distance[:, 1:]
    assert (others > 0.5).any()
    assert (others < -0.5).any()
    np.testing.assert_array_equal(env.race.worlds.lap_start[:, 0], 0.0)  # a lap from the line is timed from there


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_offset_and_heading_error_stay_within_the_configured_ones(ellipse, share):
    """offset: a share of the room that the car's half diagonal and a margin of 10 cm leave on either side."""
    env = make_race_vector(400, tracks=[ellipse], beams=0, start={"offset": share, "heading_error": 0.25})
    poses, _ = starts(env, 2)
    x, y, yaw = poses.reshape(-1, 3).T
    s, d = ellipse.centerline.to_frenet(x, y)
    error = np.remainder(yaw - ellipse.centerline.heading(s) + math.pi, 2.0 * math.pi) - math.pi
    room = 1.1 - 0.5 * math.hypot(0.58, 0.31) - 0.1
    assert np.abs(d).max() <= share * room + 2e-3
    assert np.abs(error).max() <= 0.25 + 2e-3
    assert np.abs(error).max() > 0.24
    assert error.min() < -0.24
    if share:
        assert stats.kstest(d, "uniform", args=(-share * room, 2.0 * share * room)).pvalue > 1e-5


def test_speeds_are_drawn_per_car_and_start_straight(ellipse):
    env = make_race_vector(200, tracks=[ellipse], num_cars=2, beams=0, start={"speed": (1.0, 5.0)})
    env.reset(seed=0)
    speed = env.race.worlds.state[..., 3]
    assert stats.kstest(speed.ravel(), "uniform", args=(1.0, 4.0)).pvalue > 1e-5
    assert abs(np.corrcoef(speed.T)[0, 1]) < 0.35
    np.testing.assert_array_equal(env.race.worlds.state[..., [2, 5, 6]], 0.0)
    standing = make_race_vector(5, tracks=[ellipse], beams=0)
    np.testing.assert_array_equal(standing.reset(seed=0)[0]["vel"], 0.0)


def test_a_start_is_no_faster_than_the_car(ellipse):
    env = make_race_vector(5, tracks=[ellipse], beams=0, start={"speed": 9.0}, vehicle={"v_max": 4.0})
    np.testing.assert_allclose(env.reset(seed=0)[0]["vel"][:, 0], 4.0)


def test_gaps_are_between_bumpers_and_every_order_occurs(big_circle):
    env = make_race_vector(200, tracks=[big_circle], num_cars=3, beams=0, start={"gap": (1.0, 2.0)})
    orders, gaps = set(), []
    env.reset(seed=0)
    distance = env.race.worlds.distance
    for world in range(200):
        order = np.argsort(distance[world])
        orders.add(tuple(order))
        gaps += list(np.diff(distance[world][order]) - 0.58)
    assert len(orders) == 6
    assert stats.kstest(gaps, "uniform", args=(1.0, 1.0)).pvalue > 1e-5


def test_a_track_too_narrow_for_the_car_is_said_to_be(circle):
    angle = np.linspace(0.0, 2.0 * math.pi, 100, endpoint=False)
    line = Centerline.from_points(4.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), 0.1, 0.1)
    alley = Track("alley", *_map(line), line)
    with pytest.raises(OutlapError, match=r"alley.*no start") as caught:
        make_race_vector(2, tracks=[alley], beams=0).reset(seed=0)
    assert "\n" not in str(caught.value)


def _map(line: Centerline) -> tuple[np.ndarray, float, tuple[float, float, float]]:
    occupancy, origin = draw_walls(line, 0.05, 0.5)
    return occupancy, 0.05, origin


def test_a_place_too_narrow_for_the_car_is_avoided():
    """A third of the lap is 20 cm wide: another place is drawn."""
    angle = np.linspace(0.0, 2.0 * math.pi, 300, endpoint=False)
    width = np.where(angle < 2.0 * math.pi / 3.0, 0.1, 1.0)
    line = Centerline.from_points(6.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), width, width)
    env = make_race_vector(200, tracks=[Track("funnel", *_map(line), line)], beams=0)
    poses, _ = starts(env, 2)
    at = np.arctan2(poses[..., 1], poses[..., 0]) % (2.0 * math.pi)
    assert at.min() > 2.0 * math.pi / 3.0


@pytest.mark.parametrize(
    ("field", "value"),
    [("offset", 1.5), ("offset", -0.1), ("heading_error", -1), ("gap", -1.0), ("gap", (2.0, 1.0)), ("speed", "fast")],
)
def test_wrong_values_are_refused(ellipse, field, value):
    with pytest.raises(OutlapError, match=f"start.{field}"):
        make_race_vector(1, tracks=[ellipse], beams=0, start={field: value})


FORMATIONS = ("queue", "behind", "grid", "scattered")


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    formation=st.sampled_from(FORMATIONS), cars=st.integers(2, 8), offset=st.floats(0.0, 1.0),
    heading_error=st.floats(0.0, 1.0), gap=st.floats(0.0, 1.5), spread=st.floats(0.0, 1.0), seed=st.integers(0, 10**6),
)  # fmt: skip
def test_no_formation_ever_starts_with_a_contact(big_circle, formation, cars, offset, heading_error, gap, spread, seed):
    """Rectangles against each other, whatever the formation: cars of many sizes, bumper to bumper if need be."""
    env = make_race_vector(
        10, tracks=[big_circle], num_cars=cars, beams=0, vehicle={"length": (0.4, 0.8), "width": (0.25, 0.4)},
        start={"formation": formation, "offset": offset, "heading_error": heading_error, "gap": (gap, gap + spread)},
    )  # fmt: skip
    env.reset(seed=seed)
    assert not env.race.worlds.contact.any()
    for poses, sizes in zip(
        env.race.worlds.state[..., [0, 1, 4]].astype(float),
        sizes_of(env.race.worlds.params),
        strict=True,
    ):
        bodies = [corners(pose, *size) for pose, size in zip(poses, sizes, strict=True)]
        assert all(apart(a, b) for a, b in combinations(bodies, 2))


def in_formation(track: Track, formation: str, cars: int, worlds: int = 200, **start) -> RaceVectorEnv:
    env = make_race_vector(
        worlds, tracks=[track], num_cars=cars, beams=0, start={"formation": formation, "heading_error": 0.0, **start}
    )
    env.reset(seed=0)
    return env


def test_behind_puts_the_ego_last_by_the_drawn_gap(big_circle):
    distance = in_formation(big_circle, "behind", 3, gap=(1.0, 3.0)).race.worlds.distance
    assert (distance[:, 0] < distance[:, 1:].min(axis=1)).all()
    gaps = distance[:, 1:].min(axis=1) - distance[:, 0] - 0.58
    assert stats.kstest(gaps, "uniform", args=(1.0, 2.0)).pvalue > 1e-5
    assert 60 < (distance[:, 1] > distance[:, 2]).sum() < 140, "the opponents' own order is drawn"


def test_a_grid_stands_left_and_right_by_turns(big_circle):
    worlds = in_formation(big_circle, "grid", 5, gap=(0.0, 0.0)).race.worlds
    order = np.argsort(-worlds.distance, axis=1)
    side = np.take_along_axis(worlds.frenet[..., 1], order, axis=1)
    room = 1.2 - 0.5 * math.hypot(0.58, 0.31) - 0.1
    np.testing.assert_allclose(side, np.tile(0.5 * room * np.array([1, -1, 1, -1, 1]), (200, 1)), atol=2e-3)
    assert set(order[:, 0]) == set(range(5)), "every car can be on pole"
    along = -np.diff(np.take_along_axis(worlds.distance, order, axis=1), axis=1)
    np.testing.assert_allclose(along, 0.58 + 0.1, atol=1e-6)


def test_scattered_cars_are_anywhere_on_the_lap_but_a_gap_apart(big_circle):
    worlds = in_formation(big_circle, "scattered", 4, gap=(1.5, 9.0)).race.worlds
    length = big_circle.centerline.length
    s = np.sort(worlds.distance % length, axis=1)
    between = np.concatenate([np.diff(s, axis=1), s[:, :1] + length - s[:, -1:]], axis=1)
    assert between.min() >= 0.58 + 1.5 - 1e-6
    assert between.min() < 0.58 + 1.7
    away = worlds.distance[:, 1:] - worlds.distance[:, :1]
    assert np.abs(away).max() <= 0.5 * length + 1e-6, "ahead or behind by the shorter way round"
    free = length - 4 * 2.08
    # Of a uniform arrangement: the room before the next car, of four that share what is free.
    assert stats.kstest((between[:, 0] - 2.08) / free, stats.beta(1, 3).cdf).pvalue > 1e-5


def test_more_cars_than_fit_are_said_not_to(circle):
    with pytest.raises(OutlapError, match=r"found no start free of contact.*long enough for all"):
        in_formation(circle, "scattered", 60, worlds=2)
