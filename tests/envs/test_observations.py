"""Every observation term against a hand calculation from the state."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest

from outlap.envs.keywords import make_race_vector
from outlap.envs.observations import CURVATURE_AHEAD, LINE_AHEAD, OBSERVATION_TERMS
from outlap.errors import OutlapError
from outlap.simulator.lidar import beam_directions

ALL = tuple(OBSERVATION_TERMS)


@pytest.fixture(scope="module")
def driven(ellipse, follow):
    """Eight worlds after a second of wobbly driving: (env, observation, the last action)."""
    env = make_race_vector(8, tracks=[ellipse], beams=31, observation=ALL, control_interval=5, start={"speed": 2.0})
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = np.clip(follow(env, -0.6) + rng.normal(0.0, [0.3, 0.2], (8, 2)), -1.0, 1.0).astype(np.float32)
        observation, _, terminated, _, _ = env.step(action)
        assert not terminated.any()
    return env, observation, action


def test_the_default_observation_is_the_papers(ellipse):
    env = make_race_vector(2, tracks=[ellipse])
    assert isinstance(env.single_observation_space, gym.spaces.Dict)
    assert set(env.single_observation_space.spaces) == {"scan", "pose", "vel", "heading"}
    observation, _ = env.reset(seed=0)
    assert {name: value.shape for name, value in observation.items()} == {
        "scan": (2, 540), "pose": (2, 3), "vel": (2, 3), "heading": (2, 2),
    }  # fmt: skip
    assert all(value.dtype == np.float32 for value in observation.values())


def test_pose_velocity_and_angles_come_from_the_state(driven):
    env, observation, _ = driven
    x, y, steer, speed, yaw, yaw_rate, slip = env.race.worlds.state[:, 0, :7].T.astype(np.float64)
    assert np.abs(slip).min() > 1e-4, "the test needs cars that slip"
    np.testing.assert_allclose(observation["pose"], np.stack([x, y, yaw], 1), rtol=1e-6)
    vel = np.stack([speed * np.cos(slip), speed * np.sin(slip), yaw_rate], 1)
    np.testing.assert_allclose(observation["vel"], vel, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(observation["heading"], np.stack([steer, slip], 1), rtol=1e-6)


def test_velocity_is_how_fast_the_pose_changes(ellipse, follow):
    """Without the state's columns: the difference quotient of the pose, turned into the car's frame."""
    env = make_race_vector(4, tracks=[ellipse], beams=0, start={"speed": 3.0})
    env.reset(seed=1)
    poses, vels = [], []
    for _ in range(40):
        observation = env.step(follow(env, -0.7))[0]
        poses.append(observation["pose"].astype(np.float64))
        vels.append(observation["vel"])
    before, now, after = poses[-3:]
    rate = (after - before) / 0.02
    rate[:, 2] = (np.mod(after - before + math.pi, 2.0 * math.pi) - math.pi)[:, 2] / 0.02
    cos, sin = np.cos(now[:, 2]), np.sin(now[:, 2])
    forward, left = cos * rate[:, 0] + sin * rate[:, 1], cos * rate[:, 1] - sin * rate[:, 0]
    np.testing.assert_allclose(vels[-2], np.stack([forward, left, rate[:, 2]], 1), atol=0.01)


def test_the_previous_action_is_the_one_just_carried_out_and_zero_after_a_reset(driven):
    env, observation, action = driven
    np.testing.assert_array_equal(observation["previous_action"], action)
    assert np.abs(action).min() > 0.0
    fresh, _ = env.reset(options={"reset_mask": np.arange(8) < 3})
    np.testing.assert_array_equal(fresh["previous_action"][:3], 0.0)
    np.testing.assert_array_equal(fresh["previous_action"][3:], action[3:])


def test_the_line_ahead_is_the_centreline_where_there_is_no_raceline(driven, ellipse):
    _, observation, _ = driven
    x, y, yaw = observation["pose"].astype(np.float64).T
    s, _ = ellipse.centerline.to_frenet(x, y)
    points = ellipse.centerline.position(s[:, None] + np.array(LINE_AHEAD))
    along = np.exp(-1j * yaw)[:, None] * (points[..., 0] - x[:, None] + 1j * (points[..., 1] - y[:, None]))
    seen = observation["line_ahead"].reshape(8, len(LINE_AHEAD), 3)
    np.testing.assert_allclose(seen[..., 0], along.real, atol=0.06)  # the table's spacing is 0.1 m
    np.testing.assert_allclose(seen[..., 1], along.imag, atol=0.06)
    assert (seen[..., 2] > 1.0).all()


def test_the_action_span_is_what_the_extremes_command(driven):
    env, observation, _ = driven
    params = env.race.worlds.params[:, 0]
    lock, slowest, fastest = observation["action_span"].T
    np.testing.assert_array_equal(lock, params["steer_max"])
    np.testing.assert_array_equal(slowest, params["v_min"])
    np.testing.assert_array_equal(fastest, params["v_max"])


def test_frenet_agrees_with_the_projection_on_the_spline(driven, ellipse):
    _, observation, _ = driven
    x, y, yaw = observation["pose"].astype(np.float64).T
    s, d = ellipse.centerline.to_frenet(x, y)
    error = np.mod(yaw - ellipse.centerline.heading(s) + math.pi, 2.0 * math.pi) - math.pi
    assert np.abs(d).max() > 0.1
    np.testing.assert_allclose(observation["frenet"], np.stack([d, error], 1), atol=1e-3)


def test_left_of_the_line_and_turned_left_are_positive(ellipse, put):
    env = make_race_vector(1, tracks=[ellipse], beams=0, observation="frenet")
    put(env, [3.0, 0.4, 0.2, 0.0])
    observation, *_ = env.step(np.array([[0.0, -0.6]]))  # -0.6 is standstill
    np.testing.assert_allclose(observation["frenet"], [[0.4, 0.2]], atol=1e-3)


def test_curvature_ahead_is_that_of_the_ellipse(ellipse, put):
    """At the parameter t of (a cos t, b sin t): curvature = a b / (a² sin² t + b² cos² t)^1.5."""
    env = make_race_vector(1, tracks=[ellipse], beams=0, observation="curvature_ahead")
    fine = np.linspace(0.0, 2.0 * math.pi, 200_001)
    length = np.append(0.0, np.cumsum(np.hypot(*np.diff(np.stack([9 * np.cos(fine), 5 * np.sin(fine)]), axis=1))))
    assert ellipse.centerline.length == pytest.approx(length[-1], rel=1e-6)
    for start in (0.0, 7.3, 40.0):
        put(env, [start, 0.0, 0.0, 0.0])
        observation, *_ = env.step(np.array([[0.0, -0.6]]))
        t = np.interp((start + np.array(CURVATURE_AHEAD)) % length[-1], length, fine)
        expected = 45.0 / (81.0 * np.sin(t) ** 2 + 25.0 * np.cos(t) ** 2) ** 1.5
        # Half a row of the table is 5 cm, over which the curvature changes by up to 0.005.
        np.testing.assert_allclose(observation["curvature_ahead"][0], expected, atol=6e-3)


def test_the_scan_runs_from_right_to_left(ellipse, put):
    """Close to the left wall of a nearly straight place: short ranges come last."""
    env = make_race_vector(1, tracks=[ellipse], beams=3, observation="scan", field_of_view=math.pi)
    quarter = ellipse.centerline.length / 4  # the flattest place, heading in -x
    put(env, [quarter, 0.6, 0.0, 0.0])
    scan = env.step(np.array([[0.0, -0.6]]))[0]["scan"][0]
    assert scan[2] == pytest.approx(0.5, abs=0.06)  # 1.1 - 0.6, a cell is 5 cm
    assert scan[0] == pytest.approx(1.7, abs=0.06)
    assert scan[1] > 3.0


@pytest.mark.parametrize("beams", [0, 1, 7, 1080])
def test_any_number_of_beams(ellipse, beams):
    env = make_race_vector(2, tracks=[ellipse], beams=beams)
    observation, _ = env.reset(seed=0)
    assert observation["scan"].shape == (2, beams)
    observation = env.step(np.zeros((2, 2)))[0]
    assert observation["scan"].shape == (2, beams)
    assert env.observation_space.contains(observation)


@pytest.mark.parametrize("scaled", [False, True])
def test_observations_stay_in_their_space(ellipse, scaled):
    """Random driving, crashes, reverse, awkward ranges and a scanner that is wrong in every way."""
    env = make_race_vector(
        8, tracks=[ellipse], num_cars=2, beams=40, observation=ALL, scale_observations=scaled, control_interval=4,
        lidar={"max_range": (2.9, 6.7), "noise_std": 0.3, "bias": (-0.5, 0.5), "dropout": 0.1, "mount_x": 0.2},
        termination={"time_limit": 1.5},
    )  # fmt: skip
    observation, _ = env.reset(seed=0)
    rng = np.random.default_rng(1)
    lows, highs = [], []
    for step in range(150):
        assert env.observation_space.contains(observation), f"step {step}"
        lows.append(observation["scan"].min())
        highs.append(observation["scan"].max())
        observation, _, _, _, info = env.step(rng.uniform(-1.0, 1.0, (8, 2)))
        for world in np.flatnonzero(info.get("_final_obs", [])):
            assert env.single_observation_space.contains(info["final_obs"][world])
    assert min(lows) == 0.0, "the test should reach the lower end"
    assert max(highs) > 0.97 * 6.7 / (10.0 if scaled else 1.0), "and the upper one"


def test_the_farthest_range_is_the_spaces_end_whatever_it_is(ellipse):
    """A beam that drops out reads exactly max_range; dividing it by the scale must not leave the space."""
    for farthest in np.random.default_rng(0).uniform(1.0, 40.0, 60):
        env = make_race_vector(
            1, tracks=[ellipse], beams=3, observation="scan", scale_observations=True,
            lidar={"max_range": farthest, "dropout": 1.0},
        )  # fmt: skip
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation), farthest
        np.testing.assert_allclose(observation["scan"], farthest / 10.0, rtol=1e-6)


def test_scaling_divides_by_the_declared_constants(ellipse):
    plain, scaled = (
        make_race_vector(3, tracks=[ellipse], beams=9, observation=ALL, scale_observations=on) for on in (False, True)
    )
    plain.reset(seed=5)
    scaled.reset(seed=5)
    for _ in range(10):
        action = np.array([[0.3, 0.1], [-0.3, 0.0], [0.0, 1.0]])
        a, b = plain.step(action)[0], scaled.step(action)[0]
    scales = {
        "scan": 10.0, "pose": [50.0, 50.0, math.pi], "vel": [10.0, 2.0, 5.0], "heading": 0.4, "previous_action": 1.0,
        "previous_reward": 0.1, "vehicle": 1.0, "frenet": 1.0, "curvature_ahead": 0.5,
        "line_ahead": [5.0, 5.0, 10.0] * len(LINE_AHEAD), "action_span": [0.4, 10.0, 10.0],
        "nearby_cars": [1.0, 5.0, 5.0, 1.0, 5.0] * 3,
    }  # fmt: skip
    assert set(scales) == set(ALL)
    for name, scale in scales.items():
        np.testing.assert_allclose(b[name], a[name] / np.float32(scale), rtol=1e-6, atol=1e-9)
        space, scaled_space = (env.single_observation_space for env in (plain, scaled))
        assert isinstance(space, gym.spaces.Dict)
        assert isinstance(scaled_space, gym.spaces.Dict)
        space, scaled_space = space[name], scaled_space[name]
        assert isinstance(space, gym.spaces.Box)
        assert isinstance(scaled_space, gym.spaces.Box)
        np.testing.assert_allclose(scaled_space.high, space.high / np.float32(scale), rtol=1e-6)
        np.testing.assert_allclose(scaled_space.low, space.low / np.float32(scale), rtol=1e-6)


def test_terms_come_in_the_order_asked_for_and_one_name_is_enough(ellipse):
    env = make_race_vector(1, tracks=[ellipse], observation=("vel", "scan"), beams=4)
    assert set(env.reset(seed=0)[0]) == {"vel", "scan"}
    assert set(make_race_vector(1, tracks=[ellipse], observation="vel").reset(seed=0)[0]) == {"vel"}


def test_an_unknown_term_is_refused_with_the_names_that_exist(ellipse):
    with pytest.raises(OutlapError, match=r"observation.*'speed'.*scan, pose, vel") as caught:
        make_race_vector(1, tracks=[ellipse], observation=("scan", "speed"))
    assert "\n" not in str(caught.value)
    for wrong in ((), ("vel", "vel")):
        with pytest.raises(OutlapError, match="observation"):
            make_race_vector(1, tracks=[ellipse], observation=wrong)


def test_the_ego_sees_only_its_own_car(ellipse, put):
    """Another car changes nothing but the beams that it blocks."""
    starts = np.array([[5.0, 0.1, 0.05, 2.0], [0.0, 0.0, 0.0, 2.0]])
    one = make_race_vector(3, tracks=[ellipse], beams=61, observation=ALL)
    two = make_race_vector(3, tracks=[ellipse], beams=61, observation=ALL, num_cars=2, opponent_speed=3.0)
    for away, seen in ((-2.0, False), (2.5, True)):
        starts[1, 0] = starts[0, 0] + away
        put(one, starts[:1])
        put(two, starts)
        for _ in range(20):
            action = np.tile([0.2, -0.4], (3, 1))
            alone, together = one.step(action)[0], two.step(action)[0]
        for name in set(ALL) - {"scan", "nearby_cars"}:
            np.testing.assert_array_equal(alone[name], together[name])
        shorter = together["scan"] < alone["scan"] - 0.1
        angles = np.linspace(-2.35, 2.35, 61)
        if seen:
            assert shorter.any(axis=1).all()
            assert np.abs(angles[shorter[0]]).max() < math.radians(45)
            assert (together["scan"] <= alone["scan"]).all()
        else:  # behind, where the scanner is blind
            np.testing.assert_array_equal(alone["scan"], together["scan"])


def test_beams_cover_the_field_of_view_evenly():
    """The paper's: 4.7 rad, uniformly spaced."""
    cos, sin = beam_directions(1080, 4.7)
    angles = np.arctan2(np.asarray(sin, np.float64), np.asarray(cos, np.float64))[:1080]
    np.testing.assert_allclose(angles, np.linspace(-2.35, 2.35, 1080), atol=1e-6)


def test_as_many_nearby_cars_are_told_of_as_configured(big_circle, put):
    """The nearest of three, alone, and all three with a block of zeros behind them."""
    starts = np.array([[10.0, 0.0, 0.0, 2.0], [14.0, 0.3, 0.0, 1.0], [7.0, 0.0, 0.1, 0.0], [20.0, 0.0, 0.0, 0.0]])
    told = {}
    for count in (1, 4):
        env = make_race_vector(
            1, tracks=[big_circle], num_cars=4, beams=0, nearby_cars=count, observation=("nearby_cars",)
        )
        put(env, starts)
        told[count] = env.observe(0)["nearby_cars"][0].reshape(count, 5)
        assert env.single_observation_space["nearby_cars"].shape == (5 * count,)  # type: ignore[index]
    np.testing.assert_array_equal(told[4][0], told[1][0])
    assert told[1][0][1] < 0.0, "the one behind is the nearest"
    assert told[4][:3, 0].tolist() == [1.0, 1.0, 1.0]
    np.testing.assert_allclose(told[4][:3, 4], [-2.0, -1.0, -2.0], atol=1e-6)
    np.testing.assert_array_equal(told[4][3], 0.0)
    assert (np.diff(np.hypot(*told[4][:3, 1:3].T)) > 0.0).all()
