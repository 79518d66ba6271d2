"""RaceParallelEnv: PettingZoo's own checks, and the same race as the vector environment's."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from outlap.envs.keywords import make_parallel, make_race_vector
from outlap.envs.parallel_env import RaceParallelEnv
from outlap.envs.rewards import REWARD_TERMS
from outlap.errors import OutlapError

LIMITS = {"time_limit": 0.5}


def drive(env: RaceParallelEnv, actions: dict[str, list[float]], steps: int) -> list[tuple]:
    return [env.step({agent: np.array(actions[agent]) for agent in env.agents}) for _ in range(steps)]


def test_pettingzoo_finds_nothing(ellipse):
    def build():
        return make_parallel(3, tracks=[ellipse], beams=11, termination=LIMITS, lidar={"noise_std": 0.1})

    parallel_api_test(build(), num_cycles=200)
    parallel_seed_test(build, num_cycles=50)


def test_it_is_the_race_of_the_vector_environment(ellipse, put):
    """Car 0 as its first car, and car 1 as its opponent: the same seeds, the same numbers."""
    config = {"tracks": [ellipse], "num_cars": 2, "beams": 9, "control_interval": 4, "speed_range": (0.0, None)}

    def opponent(observation) -> np.ndarray:
        return np.tile(np.array([0.15, 0.0]), (len(observation["scan"]), 1))

    single = make_race_vector(1, opponents=[opponent], **config)
    every = make_parallel(**config)
    observation, _ = single.reset(seed=4)
    observations, _ = every.reset(seed=4)
    for _ in range(15):
        for name, value in observation.items():
            np.testing.assert_array_equal(observations["car_0"][name], value[0])
        action = np.array([0.2, 0.1])
        observation, reward, terminated, truncated, info = single.step(action[None])
        observations, rewards, crashed, stopped, infos = every.step({"car_0": action, "car_1": np.array([0.15, 0.0])})
        assert (rewards["car_0"], crashed["car_0"], stopped["car_0"]) == (reward[0], terminated[0], truncated[0])
        if terminated[0]:
            return
        assert infos["car_0"]["progress_m"] == info["progress_m"][0]


def test_a_crash_ends_the_race_of_its_own_car_only(big_circle):
    env = make_parallel(3, tracks=[big_circle], beams=0, speed_range=(0.0, 8.0), start={"heading_error": 0.0})
    env.reset(seed=0)
    actions = {"car_0": [1.0, 0.0], "car_1": [0.0, -1.0], "car_2": [0.0, -1.0]}
    for _ in range(200):
        _, rewards, crashed, stopped, infos = drive(env, actions, 1)[0]
        if crashed["car_0"]:
            break
    assert infos["car_0"]["outcome"] == "crash"
    assert infos["car_0"]["contact"] == "wall"
    assert rewards["car_0"] < -1.0
    assert not stopped["car_0"]
    assert env.agents == ["car_1", "car_2"]
    observations, rewards, *_ = drive(env, actions, 1)[0]
    assert set(observations) == set(rewards) == {"car_1", "car_2"}


@pytest.mark.parametrize(("what", "seen"), [("park", True), ("remove", False)])
def test_a_wreck_stays_or_goes_as_configured(big_circle, what, seen):
    env = make_parallel(
        2, tracks=[big_circle], beams=0, speed_range=(0.0, 8.0), opponent_crash=what, observation="nearby_cars",
        termination={"stall_time": 0.0},
    )  # fmt: skip
    env.reset(seed=0)
    while "car_0" in env.agents:
        observations = drive(env, {"car_0": [1.0, 0.0], "car_1": [0.0, -1.0]}, 1)[0][0]
    observations = drive(env, {"car_1": [0.0, -1.0]}, 1)[0][0]
    assert observations["car_1"]["nearby_cars"].any() == seen


def test_a_car_that_stalls_is_truncated_and_leaves_the_track(big_circle):
    env = make_parallel(
        2, tracks=[big_circle], beams=0, speed_range=(0.0, 8.0), observation="nearby_cars",
        termination={"stall_time": 1.0}, start={"heading_error": 0.0, "gap": (6.0, 6.0)},
    )  # fmt: skip
    env.reset(seed=0)
    results = drive(env, {"car_0": [0.0, -1.0], "car_1": [0.1, -0.5]}, 100)
    assert results[-1][3]["car_0"]
    assert results[-1][4]["car_0"]["outcome"] == "stalled"
    assert env.agents == ["car_1"]
    assert not drive(env, {"car_1": [0.1, -0.5]}, 1)[0][0]["car_1"]["nearby_cars"].any()


def test_every_car_is_told_its_place_and_rewarded_for_overtaking(big_circle):
    env = make_parallel(
        2, tracks=[big_circle], beams=0, speed_range=(0.0, 8.0), termination={"time_limit": 0.0, "stall_time": 0.0},
        reward={"weights": {**dict.fromkeys(REWARD_TERMS, 0.0), "overtake": 20.0, "overtaken": 20.0}},
    )  # fmt: skip
    _, infos = env.reset(seed=0)
    assert sorted(info["place"] for info in infos.values()) == [1, 2]
    leader = next(agent for agent, info in infos.items() if info["place"] == 1)
    race = env._env.race
    race.worlds.distance[0, int(leader[-1])] -= 30.0
    _, rewards, *_, infos = drive(env, {"car_0": [0.0, -1.0], "car_1": [0.0, -1.0]}, 1)[0]
    other = ({"car_0", "car_1"} - {leader}).pop()
    assert (rewards[leader], rewards[other]) == (-20.0, 20.0)
    assert (infos[leader]["place"], infos[other]["place"]) == (2, 1)
    assert (infos[other]["places_gained"], infos[leader]["places_lost"]) == (1, 1)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"car_0": np.zeros(2)}, "none for car_1"),
        ({"car_0": np.zeros(2), "car_1": np.zeros(3)}, r"car_1: given actions of shape \(3,\); must be \(2,\)"),
        (
            {"car_0": np.array([0.0, np.nan]), "car_1": np.zeros(2)},
            r"car_0: given the action \[0\.0, nan\]; must be finite",
        ),
    ],
)
def test_wrong_actions_are_named(ellipse, actions, message):
    env = make_parallel(2, tracks=[ellipse], beams=0)
    env.reset(seed=0)
    with pytest.raises(OutlapError, match=message):
        env.step(actions)


@pytest.mark.parametrize(
    ("config", "message"),
    [({"opponents": "pure-pursuit"}, "opponents: .* leave it out"), ({"opponent_crash": "respawn"}, "park or remove")],
)
def test_what_a_race_of_agents_has_no_use_for_is_refused(ellipse, config, message):
    with pytest.raises(OutlapError, match=message):
        make_parallel(2, tracks=[ellipse], **config)
