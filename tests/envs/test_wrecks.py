"""Contacts: what was hit and how hard, and what becomes of an opponent that crashed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.envs.keywords import make_race_vector
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.simulator.collision import FREE, HIT_CAR, HIT_WALL, REMOVED

STANDSTILL = np.array([[0.0, -1.0]])
LIMITS = {"time_limit": 0.0, "stall_time": 0.0}


def straight_on(observation) -> np.ndarray:
    """A driver that goes straight on at top speed, into the wall of a circle."""
    return np.tile(np.array([0.0, 1.0]), (len(observation["frenet"]), 1))


straight_on.observation_terms = ("frenet",)  # pyright: ignore[reportFunctionMemberAccess]


def stands(observation) -> np.ndarray:
    """A driver that does not start."""
    return np.tile(np.array([0.0, -1.0]), (len(observation["frenet"]), 1))


stands.observation_terms = ("frenet",)  # pyright: ignore[reportFunctionMemberAccess]


def race(track, driver, num_cars: int = 2, beams: int = 0, **config) -> RaceVectorEnv:
    return make_race_vector(
        1, tracks=[track], num_cars=num_cars, beams=beams, opponents=[driver], opponent_speed=4.0,
        speed_range=(0.0, 8.0), termination=LIMITS, control_interval=2, **config,
    )  # fmt: skip


def final(env: RaceVectorEnv, action) -> dict:
    """The summary of the episode that ends now or soon."""
    for _ in range(500):
        *_, info = env.step(np.array([action]))
        if "final_info" in info:
            return {name: value[0] for name, value in info["final_info"].items()}
    raise AssertionError("the episode does not end")


def test_a_wall_is_hit_at_the_cars_own_speed(big_circle, put):
    env = race(big_circle, stands)
    put(env, np.array([[0.0, 0.0, 0.5 * math.pi, 3.0], [20.0, 0.0, 0.0, 0.0]]))
    info = final(env, [0.0, 3.0 / 4.0 - 1.0])
    assert (info["outcome"], info["contact"]) == ("crash", "wall")
    assert info["impact_speed_mps"] == pytest.approx(3.0, rel=0.01)


def test_a_standing_car_is_hit_at_the_cars_own_speed(big_circle, put):
    env = race(big_circle, stands)
    put(env, np.array([[0.0, 0.0, 0.0, 3.0], [1.2, 0.0, 0.0, 0.0]]))
    info = final(env, [0.1, 3.0 / 4.0 - 1.0])
    assert (info["outcome"], info["contact"]) == ("crash", "car")
    assert info["impact_speed_mps"] == pytest.approx(3.0, rel=0.02)
    assert info["opponent_crashes"] == 1


def test_a_moving_car_is_hit_at_the_speed_between_the_two(big_circle, put):
    """Nose to tail on an arc at 5 and 4 m/s, and head on: the difference of the velocities, as vectors."""
    env = race(big_circle, straight_on)
    put(env, np.array([[0.0, 0.0, 0.0, 6.0], [0.8, 0.0, 0.0, 4.0]]))
    assert final(env, [0.0, 0.5])["impact_speed_mps"] == pytest.approx(2.0, abs=0.5)
    put(env, np.array([[0.0, 0.0, 0.0, 4.0], [1.6, 0.0, math.pi, 4.0]]))
    assert final(env, [0.0, 0.0])["impact_speed_mps"] == pytest.approx(8.0, abs=0.3)


def crash_alone(env: RaceVectorEnv, put, steps: int = 60) -> dict:
    """The ego stands at s = 0; the opponent, at s = 20 m, drives into the wall."""
    put(env, np.array([[0.0, 0.6, 0.0, 0.0], [20.0, 0.0, 1.2, 4.0]]))
    info: dict = {}
    for _ in range(steps):
        *_, info = env.step(STANDSTILL)
    return info


def test_a_parked_wreck_stays_seen_and_counts_once(big_circle, put):
    env = race(big_circle, straight_on, opponent_crash="park")
    info = crash_alone(env, put)
    assert env.race.worlds.contact[0].tolist() == [FREE, HIT_WALL]
    assert info["opponent_crashes"][0] == 1
    assert (info["outcome"][0], info["contact"][0]) == ("", "")


def test_a_removed_wreck_is_neither_seen_nor_touched_nor_passed(big_circle, put):
    env = race(big_circle, straight_on, beams=31, opponent_crash="remove", observation=("scan", "nearby_cars"))
    info = crash_alone(env, put)
    assert env.race.worlds.contact[0].tolist() == [FREE, REMOVED]
    assert info["opponent_crashes"][0] == 1
    # The ego is put where the wreck would be: alone it sees the same, and touches nothing.
    wreck = env.race.worlds.state[0, 1, [0, 1, 4]].copy()
    env.race.worlds.state[0, 0, [0, 1, 4]] = wreck
    middle = big_circle.centerline.to_frenet(wreck[:1].astype(float), wreck[1:2].astype(float))[0]
    x, y = big_circle.centerline.position(middle)[0]
    env.race.worlds.state[0, 0, [0, 1]] = x, y
    env.race.worlds.state[0, 1, [0, 1]] = x + 0.3, y
    observation, _, terminated, _, info = env.step(STANDSTILL)
    assert not terminated[0]
    np.testing.assert_array_equal(observation["nearby_cars"], 0.0)
    alone = make_race_vector(1, tracks=[big_circle], beams=31, observation="scan", speed_range=(0.0, 8.0))
    alone.reset(seed=0)
    alone.race.worlds.state[0, 0] = env.race.worlds.state[0, 0]
    alone.race.worlds.state[0, 0, 3] = 0.0
    np.testing.assert_allclose(alone.step(STANDSTILL)[0]["scan"], observation["scan"], atol=0.02)
    env.race.worlds.distance[0] = 30.0, 20.0
    env.race.advance(0.3)
    assert not env.race.places_gained.any()


def test_a_respawned_car_stands_on_the_centreline_where_it_crashed_and_goes_on(big_circle, put):
    env = race(big_circle, straight_on, opponent_crash="respawn")
    put(env, np.array([[0.0, 0.6, 0.0, 0.0], [20.0, 0.0, 1.2, 4.0]]))
    worlds, crashes = env.race.worlds, []
    for _ in range(100):
        before = worlds.distance[0, 1]
        *_, info = env.step(STANDSTILL)
        crashes.append(int(info["opponent_crashes"][0]))
        if len(crashes) > 1 and crashes[-1] > crashes[-2]:
            assert worlds.contact[0, 1] == FREE
            assert worlds.state[0, 1, 3] == 0.0
            np.testing.assert_allclose(worlds.frenet[0, 1, 1:], 0.0, atol=2e-3)
            assert worlds.distance[0, 1] == pytest.approx(before, abs=0.1)
    assert crashes[-1] >= 2, "straight on it crashes again"
    assert worlds.distance[0, 1] > 22.0, "and between two crashes it gets further"


def test_whoever_went_by_while_a_car_was_off_the_track_has_overtaken_nobody(big_circle, put):
    env = race(big_circle, stands, opponent_crash="respawn")
    put(env, np.array([[10.0, 0.6, 0.0, 0.0], [20.0, 0.0, 0.0, 0.0]]))
    env.race.simulator.remove(np.array([[False, True]]))
    env.race.advance(0.3)
    env.race.worlds.distance[0, 0] = 30.0
    env.race.advance(0.3)
    env.race.simulator.respawn(3.0)
    for gained in (0, 0):
        env.race.advance(0.3)
        assert env.race.places_gained[0, 0] == gained
    env.race.worlds.distance[0, 0] = 10.0
    env.race.advance(0.3)
    assert env.race.places_lost[0, 0] == 1, "from then on places count again"


def test_a_car_comes_back_only_where_there_is_room(big_circle, put):
    """The ego stands beside the wreck: the opponent waits until it has gone."""
    env = race(big_circle, straight_on, opponent_crash="respawn")
    put(env, np.array([[20.6, -0.8, 0.0, 0.0], [20.0, 0.0, 1.2, 4.0]]))
    for _ in range(50):
        env.step(STANDSTILL)
    worlds = env.race.worlds
    assert worlds.contact[0].tolist() == [FREE, REMOVED]
    worlds.state[0, 0, [0, 1]] = big_circle.centerline.position(np.array([40.0]))[0]
    env.step(STANDSTILL)
    assert worlds.contact[0].tolist() == [FREE, FREE]


def test_the_ego_ends_its_own_episode_whatever_becomes_of_wrecks(big_circle, put):
    env = race(big_circle, straight_on, opponent_crash="respawn")
    put(env, np.array([[0.0, 0.0, 0.5 * math.pi, 3.0], [20.0, 0.0, 0.0, 0.0]]))
    assert final(env, [0.0, 0.0])["outcome"] == "crash"


def test_of_two_cars_that_touch_both_are_wrecks(big_circle, put):
    env = race(big_circle, stands, num_cars=3)
    put(env, np.array([[0.0, 0.0, 0.0, 0.0], [20.0, 0.0, 0.0, 4.0], [20.7, 0.0, 0.0, 0.0]]))
    for _ in range(20):
        *_, info = env.step(STANDSTILL)
    assert env.race.worlds.contact[0].tolist() == [FREE, HIT_CAR, HIT_CAR]
    assert info["opponent_crashes"][0] == 2
