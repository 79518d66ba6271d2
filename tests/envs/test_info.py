"""What `info` tells of an episode: laps and their times, sums, the task, the opponents."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.envs.episodes import EPISODE_FIELDS
from outlap.envs.keywords import make_race_vector
from outlap.simulator.vehicle import N_PARAMS, to_values


def test_the_final_infos_numbers(ellipse, follow):
    """Against sums kept here, over whole episodes in which the ego brakes and wobbles."""
    worlds, interval = 3, 4
    env = make_race_vector(
        worlds, tracks=[ellipse], beams=0, control_interval=interval, termination={"time_limit": 2.0},
        start={"speed": 2.0},
    )  # fmt: skip
    env.reset(seed=2)
    rng = np.random.default_rng(0)
    line = ellipse.centerline
    reward_sum, speed_sum, advance = np.zeros(worlds), np.zeros(worlds), np.zeros(worlds)
    s = line.to_frenet(*env.race.worlds.state[:, 0, :2].T)[0]
    speeds_now = None
    for _ in range(50):
        actions = np.clip(follow(env, -0.5) + rng.normal(0.0, 0.1, (worlds, 2)), -1.0, 1.0)
        _, rewards, terminated, truncated, info = env.step(actions)
        assert not terminated.any()
        reward_sum += rewards
        if truncated.all():
            break
        speeds_now = env.race.worlds.state[:, 0, 3].astype(float)
        speed_sum += speeds_now
        after = line.to_frenet(*env.race.worlds.state[:, 0, :2].T)[0]
        advance += np.mod(after - s + 5.0, line.length) - 5.0
        s = after
        np.testing.assert_allclose(info["progress_m"], advance, atol=2e-3)
        np.testing.assert_allclose(info["episode_return"], reward_sum, rtol=1e-9)
    final = info["final_info"]
    assert set(EPISODE_FIELDS) < set(final)
    np.testing.assert_array_equal(final["outcome"], "timeout")
    np.testing.assert_array_equal(final["episode_steps"], 50)
    np.testing.assert_allclose(final["time_s"], 2.0)
    np.testing.assert_allclose(final["episode_return"], reward_sum, rtol=1e-9)
    assert speeds_now is not None
    np.testing.assert_allclose(final["mean_speed_mps"], (speed_sum + speeds_now) / 50, rtol=0.01)
    ends = np.array([obs["pose"][:2] for obs in info["final_obs"]], float)
    advance += np.mod(line.to_frenet(*ends.T)[0] - s + 5.0, line.length) - 5.0
    np.testing.assert_allclose(final["progress_m"], advance, atol=2e-3)
    np.testing.assert_array_equal(final["completed_laps"], 0)
    assert np.isnan(final["lap_time_s"]).all()
    np.testing.assert_array_equal(final["overtakes"] + final["places_lost"] + final["impact_speed_mps"], 0)
    np.testing.assert_array_equal(final["track"], "ellipse")
    assert final["vehicle"].shape == (worlds, 1, N_PARAMS)
    np.testing.assert_array_equal(info["episode_return"], 0.0)
    np.testing.assert_array_equal(info["progress_m"], 0.0)


def test_the_impact_speed_of_a_crash(ellipse, put):
    env = make_race_vector(1, tracks=[ellipse], beams=0)
    put(env, [0.0, 0.0, 1.4, 5.0])
    speeds = []
    info: dict = {}
    while "final_info" not in info:
        speeds.append(float(env.race.worlds.state[0, 0, 3]))
        info = env.step(np.array([[0.0, -0.2]]))[-1]  # holds 5 m/s
    assert info["final_info"]["outcome"] == ["crash"]
    assert info["final_info"]["impact_speed_mps"][0] == pytest.approx(5.0, abs=0.05)
    assert speeds[-1] == pytest.approx(5.0, abs=0.05)


def test_laps_are_timed_from_line_to_line(circle, put, follow):
    """Against crossings interpolated here from poses alone; the out-lap does not count."""
    env = make_race_vector(1, tracks=[circle], beams=0, observation="pose", termination={"stall_time": 0.0})
    length = circle.centerline.length
    put(env, [length - 3.0, 0.0, 0.0, 4.0])
    angle = -3.0 / 4.0
    crossings, laps = [], []
    for step in range(1, 2400):
        before = angle
        observation, *_, info = env.step(follow(env, -0.28 + 0.04 * math.sin(0.003 * step)))
        x, y, _ = observation["pose"][0].astype(float)
        angle += np.mod(math.atan2(y, x) - before + math.pi, 2.0 * math.pi) - math.pi
        if math.floor(angle / (2.0 * math.pi)) > math.floor(before / (2.0 * math.pi)):
            line = 2.0 * math.pi * math.floor(angle / (2.0 * math.pi))
            crossings.append(0.01 * (step - (angle - line) / (angle - before)))
        assert info["laps"][0] == info["completed_laps"][0] == max(len(crossings) - 1, 0)
        times = np.diff(crossings)
        if len(times):
            assert info["last_lap_time_s"][0] == pytest.approx(times[-1], abs=1e-3)
            assert info["lap_time_s"][0] == pytest.approx(times.mean(), abs=1e-3)
        else:
            assert np.isnan([info["last_lap_time_s"][0], info["lap_time_s"][0]]).all()
        laps.append(info["laps"][0])
    assert max(laps) >= 3
    assert abs(np.diff(crossings)[0] - np.diff(crossings)[1]) > 0.01, "the test needs laps that differ"
    assert info["laps"][0] == env.race.worlds.laps[0, 0]
    assert info["last_lap_time_s"][0] == env.race.worlds.lap_time[0, 0]


def test_reversing_over_the_line_completes_no_lap(circle, put):
    """Half a metre before it and half a metre behind it, three times each."""
    env = make_race_vector(1, tracks=[circle], beams=0, termination={"stall_time": 0.0})
    put(env, [0.5, 0.0, 0.0, 0.0])
    for speed_action, there in 3 * [(-0.75, -1.0), (-0.45, 0.0)]:  # 1.9 m/s either way
        progress = -0.5
        while (progress - there) * (speed_action + 0.6) < 0.0:
            _, _, terminated, truncated, info = env.step(np.array([[0.196, speed_action]]))
            assert not (terminated | truncated).any()
            progress = info["progress_m"][0]
    assert info["laps"][0] == info["completed_laps"][0] == 0
    assert np.isnan(info["last_lap_time_s"][0])


def test_info_tells_the_task(ellipse, circle):
    """The track, every car's parameters and the opponents' speeds, as the simulator has them."""
    env = make_race_vector(
        5, tracks=[ellipse, circle], num_cars=2, beams=0, vehicle={"mu": (0.5, 1.1)}, opponent_speed=(1.0, 4.0)
    )
    _, info = env.reset(seed=0)
    worlds = env.race.worlds
    names = [env.race.simulator.tracks[number].name for number in worlds.track]
    np.testing.assert_array_equal(info["track"], names)
    np.testing.assert_array_equal(info["vehicle"], to_values(worlds.params))
    speeds = info["opponent_speed_mps"]
    assert speeds.shape == (5, 1)
    assert len(np.unique(speeds)) == 5
    assert ((speeds >= 1.0) & (speeds <= 4.0)).all()


def test_opponents_follow_the_track_at_their_own_speed(ellipse, circle, big_circle, put):
    """The ego stands half a lap away. They come round without a crash, no faster than their top speed."""
    env = make_race_vector(
        6, tracks=[ellipse, circle, big_circle], num_cars=3, beams=0, opponent_speed=(1.0, 3.0),
        termination={"stall_time": 0.0, "time_limit": 0.0},
    )  # fmt: skip
    _, info = env.reset(seed=0)
    assert len(set(info["track"])) == 3
    starts = np.zeros((6, 3, 4))
    starts[:, 1, 0], starts[:, 2, 0] = 0.5 * env.race.length, 0.5 * env.race.length - 2.0
    starts[:, 1:, 1] = 0.3
    put(env, starts)
    speeds = np.sort(env.reset(seed=0)[1]["opponent_speed_mps"], axis=1)
    put(env, starts)
    env.race.speeds[:, 1:, 1] = env.race.worlds.params["v_max"][:, 1:] = speeds[:, ::-1]  # the leader is the faster one
    fastest = np.zeros((6, 2))
    for _ in range(350):
        _, _, terminated, truncated, info = env.step(np.tile([0.0, -0.6], (6, 1)))
        assert not (terminated | truncated).any()
        fastest = np.maximum(fastest, env.race.worlds.state[:, 1:, 3])
    assert not env.race.worlds.contact.any()
    np.testing.assert_allclose(fastest, speeds[:, ::-1], rtol=0.02)
    driven = env.race.worlds.distance[:, 1:] - starts[:, 1:, 0]
    assert (driven > 0.8 * 3.5 * speeds[:, ::-1] - 0.5).all()
    assert np.abs(env.race.worlds.frenet[:, 1:, 1]).max() < 0.15, "they should have found back to the centreline"
