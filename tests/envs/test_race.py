"""Who is ahead: overtakes, places lost, and what does not count as either."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.envs.keywords import make_race_vector
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.rewards import REWARD_TERMS

LENGTH = 0.58  # [m] of a car
OVERTAKE_ONLY = {"weights": {**dict.fromkeys(REWARD_TERMS, 0.0), "overtake": 20.0, "overtaken": 20.0}}
NO_LIMITS = {"time_limit": 0.0, "stall_time": 0.0}


def duel(track, opponent_speed: float, num_cars: int = 2, **config) -> RaceVectorEnv:
    return make_race_vector(
        1, tracks=[track], num_cars=num_cars, beams=0, control_interval=2, opponent_speed=opponent_speed,
        speed_range=(0.0, 10.0), reward=OVERTAKE_ONLY, termination=NO_LIMITS, **config,
    )  # fmt: skip


def drive(env: RaceVectorEnv, follow, speed: float, seconds: float, offset: float = 0.0) -> tuple[list[float], dict]:
    """Reward of every step, and the last info, of driving `offset` [m] left of the centreline."""
    rewards: list[float] = []
    info: dict = {}
    for _ in range(round(seconds / 0.02)):
        _, reward, terminated, truncated, info = env.step(follow(env, speed / 5.0 - 1.0, offset))
        assert not (terminated | truncated).any()
        rewards.append(float(reward[0]))
    return rewards, info


@pytest.mark.parametrize("s", [10.0, 0.5, 49.8])
def test_passing_a_slower_car_counts_once(big_circle, put, follow, s):
    """Wherever on the lap: in the open, and with the start line between the two cars."""
    env = duel(big_circle, opponent_speed=1.0)
    put(env, np.array([[s - 1.5, 0.6, 0.0, 4.0], [s, 0.0, 0.0, 1.0]]))
    rewards, info = drive(env, follow, 4.0, 3.0, 0.6)
    assert env.race.distance[0, 0] > env.race.worlds.distance[0, 1] + 4.0
    assert info["overtakes"][0] == 1
    assert info["places_lost"][0] == 0
    assert [reward for reward in rewards if reward] == [20.0]


def test_the_overtake_counts_when_the_lead_is_a_car_long(big_circle, put, follow):
    env = duel(big_circle, opponent_speed=1.0)
    put(env, np.array([[8.5, 0.6, 0.0, 3.0], [10.0, 0.0, 0.0, 1.0]]))
    while True:
        _, reward, *_ = env.step(follow(env, -0.4, 0.6))
        lead = env.race.distance[0, 0] - env.race.worlds.distance[0, 1]
        if reward[0]:
            break
        assert lead <= LENGTH + 1e-6
    assert LENGTH < lead < LENGTH + 0.1


@pytest.mark.parametrize("s", [10.0, 0.5])
def test_being_overtaken_costs_the_same(big_circle, put, follow, s):
    env = duel(big_circle, opponent_speed=4.0)
    put(env, np.array([[s, 0.6, 0.0, 1.0], [s - 1.5, 0.0, 0.0, 4.0]]))
    rewards, info = drive(env, follow, 1.0, 3.0, 0.6)
    assert info["overtakes"][0] == 0
    assert info["places_lost"][0] == 1
    assert [reward for reward in rewards if reward] == [-20.0]


def test_a_whole_field_is_counted_car_by_car(big_circle, put, follow):
    """Past two slow cars, while nothing that is already behind counts."""
    env = duel(big_circle, opponent_speed=0.5, num_cars=4)
    starts = [[10.0, 0.7, 0, 4], [12.0, -0.3, 0, 0.5], [15.0, -0.3, 0, 0.5], [7.0, -0.3, 0, 0.5]]
    put(env, np.array(starts))
    rewards, info = drive(env, follow, 4.0, 3.0, 0.7)
    assert info["overtakes"][0] == 2
    assert info["places_lost"][0] == 0
    assert sum(rewards) == 40.0


def test_lapping_a_car_is_no_overtake(circle, put, follow):
    """Past a car that stands, three times: a place can be gained from it once."""
    env = duel(circle, opponent_speed=0.0)
    put(env, np.array([[10.0, 0.6, 0.0, 4.0], [12.0, -0.6, 0.0, 0.0]]))
    _, info = drive(env, follow, 4.0, 16.0, 0.6)
    assert info["progress_m"][0] > 2.2 * circle.centerline.length
    assert info["overtakes"][0] == 1
    assert info["places_lost"][0] == 0


def test_being_lapped_is_no_place_lost(circle, put, follow):
    """Passed by the leader again, a whole lap down: that place was lost the first time."""
    env = duel(circle, opponent_speed=4.0)
    put(env, np.array([[12.0, 0.7, 0.0, 0.0], [10.0, -0.2, 0.0, 4.0]]))
    _, info = drive(env, follow, 0.0, 16.0, 0.7)
    assert env.race.worlds.distance[0, 1] - env.race.distance[0, 0] > 1.5 * circle.centerline.length
    assert info["overtakes"][0] == 0
    assert info["places_lost"][0] == 1


def test_neither_overtakes_nor_places_lost_by_reversing_over_the_line(big_circle, put):
    """Rolling back across the start line is not falling a lap behind."""
    env = duel(big_circle, opponent_speed=0.0)
    put(env, np.array([[0.3, 0.6, 0.0, -2.0], [-4.0, -0.6, 0.0, 0.0]]))
    for _ in range(20):
        info = env.step(np.array([[0.0, -1.0]]))[-1]
    assert -1.0 < env.race.distance[0, 0] < -0.01, "the test needs to cross the line backwards"
    assert info["overtakes"][0] == info["places_lost"][0] == 0


def test_places_change_only_by_a_cars_length(big_circle, put):
    """The lead, step by step, and the place it leaves the ego with: wheel to wheel changes nothing."""
    env = duel(big_circle, opponent_speed=1.0, vehicle={"length": 0.5})
    put(env, np.array([[10.0, 0.5, 0.0, 0.0], [12.0, -0.5, 0.0, 0.0]]))
    race, distance = env.race, env.race.worlds.distance
    sequence = [  # lead [m], gained, lost
        (-2.0, 0, 0), (-0.1, 0, 0), (0.3, 0, 0), (-0.3, 0, 0), (0.49, 0, 0), (0.51, 1, 0), (0.3, 0, 0), (-0.49, 0, 0),
        (0.3, 0, 0), (-0.49, 0, 0), (-0.51, 0, 1), (-0.3, 0, 0), (0.49, 0, 0), (5.0, 1, 0), (45.0, 0, 0), (70.0, 0, 0),
        (-70.0, 0, 1),
    ]  # fmt: skip
    for lead, gained, lost in sequence:
        distance[0] = 12.0 + lead, 12.0
        race.advance(0.3)
        assert (race.places_gained[0, 0], race.places_lost[0, 0]) == (gained, lost), lead


def test_the_order_at_the_start_is_the_order_on_the_track(big_circle):
    """On the grid around the start line, whoever the draw puts in front: no car has gained a place by step one."""
    env = make_race_vector(
        60, tracks=[big_circle], num_cars=3, beams=0, start={"anywhere": False}, reward=OVERTAKE_ONLY,
        speed_range=(0.0, 10.0), opponent_speed=0.0,
    )  # fmt: skip
    env.reset(seed=0)
    x, y = env.race.worlds.state[..., 0].astype(float), env.race.worlds.state[..., 1].astype(float)
    along = np.arctan2(y, x) * 8.0  # the field is far shorter than half a lap
    in_front = along[:, :1] > along
    np.testing.assert_array_equal(env.race.ahead[:, 0, 1:], in_front[:, 1:])
    assert 20 < in_front[:, 1:].sum() < 100
    assert (along[:, 1:] < 0.0).any()
    assert (along[:, 1:] > 0.0).any()
    _, rewards, _, _, info = env.step(np.tile([0.0, -1.0], (60, 1)))
    np.testing.assert_array_equal(rewards, 0.0)
    np.testing.assert_array_equal(info["overtakes"] + info["places_lost"], 0)


def test_an_opponent_that_stands_in_a_car_without_reverse_stays_where_it_is(circle):
    env = duel(circle, opponent_speed=0.0, vehicle={"v_min": 0.0})
    env.reset(seed=0)
    before = env.race.worlds.state[:, 1].copy()
    for _ in range(5):
        env.step(np.zeros((1, 2)))
    np.testing.assert_array_equal(env.race.worlds.state[:, 1, :2], before[:, :2])
