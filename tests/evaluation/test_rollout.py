"""The episodes of an evaluation: which they are, and that they are raced as anybody else would race them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pandas.testing import assert_frame_equal

from outlap.drivers.classical import CenterlineFollower
from outlap.drivers.driver import Driver, FunctionDriver
from outlap.drivers.policy import PolicyDriver
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.race_env import RaceEnv
from outlap.envs.rewards import RewardConfig
from outlap.envs.terminations import TerminationConfig
from outlap.errors import OutlapError
from outlap.evaluation import rollout
from outlap.evaluation.protocol import drawn_parameters, episode_seeds, standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.planning.plan import DEFAULT_MARGIN
from outlap.simulator.vehicle import ActuatorParams, LidarParams, PacejkaTyre, VehicleParams, parameter_bounds
from synthetic_tracks import circular, ring
from untrained_policies import untrained_ppo

LARGE = ring(radius=5.0, half_width=0.8)
SMALL = ring(radius=4.0, half_width=0.8)

# At full speed tyres with little friction leave the ring: some episodes end early, and some do not.
SLIPPERY = RaceConfig(
    beams=12,
    control_interval=8,
    speed_range=(0.0, 5.0),
    vehicle=VehicleParams(mu=(0.2, 1.0), m=(3.0, 4.5)),
    lidar=LidarParams(noise_std=0.02),
    observation=("scan", "vel", "heading", "previous_action"),
    scale_observations=True,
    termination=TerminationConfig(time_limit=12.0, laps=1),
)


def follower(speed_action: float = 1.0) -> Any:
    """At full speed by default."""
    return CenterlineFollower(speed_action=speed_action)


@pytest.fixture(scope="module")
def policy() -> PolicyDriver:
    return PolicyDriver(untrained_ppo(SLIPPERY, LARGE), scale_observations=True)


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return evaluate(follower(), SLIPPERY, [LARGE, SMALL], episodes=6, seed=5, num_worlds=4)


def race_alone(driver: Any, config: RaceConfig, track, seed: int) -> dict[str, Any]:
    """One episode in an environment of its own, with nothing of the evaluation's code."""
    changes = {"observation": driver.observation_terms, "scale_observations": driver.scale_observations}
    env = RaceEnv(config.model_copy(update=changes), [track])
    observation, info = env.reset(seed=seed)
    while True:
        action = driver.act({name: value[None] for name, value in observation.items()})[0]
        observation, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return {
                "lap_time_s": np.nan,
                **info,
                "last_reward": reward,
                "terminated": terminated,
                "truncated": truncated,
            }


def test_outcomes_are_mixed(rows):
    """Otherwise the tests below could not see a preference for short episodes."""
    assert set(rows["outcome"]) >= {"crash", "finished"}


def test_the_set_of_episodes_is_fixed_in_advance(rows):
    assert rows["track"].tolist() == ["ring5"] * 6 + ["ring4"] * 6
    assert rows["episode"].tolist() == [*range(6), *range(6)]
    expected = [*episode_seeds(5, "ring5", 6), *episode_seeds(5, "ring4", 6)]
    assert rows["seed"].tolist() == expected
    assert len(set(expected)) == 12


@pytest.mark.parametrize("num_worlds", [1, 6, 50])
def test_rows_do_not_depend_on_the_number_of_worlds(rows, num_worlds):
    again = evaluate(follower(), SLIPPERY, [LARGE, SMALL], episodes=6, seed=5, num_worlds=num_worlds)
    assert_frame_equal(again, rows, check_exact=True)


def test_rows_of_a_policy_do_not_depend_on_the_number_of_worlds(policy):
    few, many = (evaluate(policy, SLIPPERY, [LARGE], episodes=8, seed=1, num_worlds=n) for n in (3, 8))
    assert_frame_equal(few, many, check_exact=True)
    assert len(set(few["progress_m"])) == 8


def test_a_track_is_raced_the_same_whatever_is_raced_before_it(rows):
    alone = evaluate(follower(), SLIPPERY, [SMALL], episodes=6, seed=5)
    assert_frame_equal(alone, rows[6:].reset_index(drop=True), check_exact=True)


def test_more_episodes_begin_with_the_same_ones(rows):
    fewer = evaluate(follower(), SLIPPERY, [LARGE], episodes=4, seed=5)
    assert_frame_equal(fewer, rows[:4], check_exact=True)


def test_another_seed_gives_other_episodes(rows):
    other = evaluate(follower(), SLIPPERY, [LARGE], episodes=6, seed=6)
    assert not set(other["seed"]) & set(rows["seed"])
    assert not np.isclose(other["vehicle_mu"], rows["vehicle_mu"][:6]).any()


@pytest.mark.parametrize("which", [0, 2, 5])
def test_an_episode_is_the_one_that_its_seed_gives(rows, which):
    row = rows.iloc[which]
    alone = race_alone(follower(), SLIPPERY, LARGE, int(row["seed"]))
    for name in (
        "outcome", "terminated", "truncated", "episode_steps", "episode_return", "last_reward", "completed_laps",
        "lap_time_s", "progress_m", "mean_speed_mps", "overtakes", "places_lost",
    ):  # fmt: skip
        np.testing.assert_equal(row[name], alone[name], err_msg=name)
    np.testing.assert_equal(row["duration_s"], alone["time_s"])


def test_rows_agree_with_each_other(rows):
    crashed = rows["outcome"] == "crash"
    assert rows["terminated"].tolist() == crashed.tolist()
    assert rows["truncated"].tolist() == (~crashed).tolist()
    assert rows["impact_speed_mps"].notna().tolist() == crashed.tolist()
    assert (rows["impact_speed_mps"][crashed] > 0.5).all()
    for name in ("crash_s_m", "crash_d_m"):
        assert rows[name].notna().tolist() == crashed.tolist()
    for track in (LARGE, SMALL):
        crashes, length = rows[crashed & (rows["track"] == track.name)], track.centerline.length
        gone = crashes["start_m"] + crashes["progress_m"] - crashes["crash_s_m"]
        np.testing.assert_allclose(circular(gone.to_numpy(), length), 0.0, atol=1e-6)
        assert crashes["crash_s_m"].between(0.0, length, inclusive="left").all()
        assert crashes["crash_d_m"].abs().between(0.8 - 0.4, 0.8).all()  # a car is 0.58 m long, the wall 0.8 m away
    np.testing.assert_allclose(rows["duration_s"], rows["episode_steps"] * 0.08, rtol=1e-9)
    assert rows["lap_time_s"].notna().tolist() == (rows["completed_laps"] > 0).tolist()
    whole = rows[rows["outcome"] == "finished"]
    # From anywhere to the line, and once around: from one to two laps.
    laps = whole["progress_m"] / whole["track"].map({t.name: t.centerline.length for t in (LARGE, SMALL)})
    assert laps.between(1.0, 2.05).all()
    # A path at offset d is longer than the arc by d / radius; the walls bound d. Speed holds 2 % of sideslip.
    ratio = whole["mean_speed_mps"] * whole["duration_s"] / whole["progress_m"]
    assert ratio.between(0.98 * (1 - 0.8 / 4.0), 1.02 * (1 + 0.8 / 4.0)).all()


def test_drawn_parameters_tell_why_cars_crash(rows):
    drawn = [name for name in rows.columns if name.startswith(("vehicle_", "lidar_", "actuators_"))]
    assert drawn == ["vehicle_mu", "vehicle_m"]
    assert rows["vehicle_mu"].between(0.2, 1.0).all()
    crashed = rows["outcome"].to_numpy() == "crash"
    friction = rows["vehicle_mu"].to_numpy()
    for track in ("ring5", "ring4"):
        here = rows["track"].to_numpy() == track
        assert friction[here & crashed].max() < friction[here & ~crashed].min()


def test_drawn_parameters_name_the_right_columns():
    config = RaceConfig(
        vehicle=VehicleParams(width=(0.25, 0.31), tyre=PacejkaTyre(p_cy1=(1.2, 1.4))),
        actuators=ActuatorParams(speed_lag=(0.0, 0.1)),
        lidar=LidarParams(dropout=(0.0, 0.2)),
    )
    low, high = parameter_bounds(config.vehicle, config.actuators, config.lidar, config.sensors)
    ends = {name: (pytest.approx(low[at]), pytest.approx(high[at])) for name, at in drawn_parameters(config).items()}
    assert ends == {
        "vehicle_width": (0.25, 0.31),
        "vehicle_tyre_p_cy1": (1.2, 1.4),
        "actuators_speed_lag": (0.0, 0.1),
        "lidar_dropout": (0.0, 0.2),
    }


def test_rewards_are_those_at_the_end_of_every_curriculum():
    weights = {"progress": 0.0, "collision": 1.0, "steering_change": 0.0, "speed_change": 0.0}
    reward = RewardConfig(weights=weights, collision_max=7.0)
    task = SLIPPERY.model_copy(update={"reward": reward})
    rows = evaluate(follower(), task, [LARGE], episodes=6, seed=5, num_worlds=3)
    assert set(rows["outcome"]) >= {"crash", "finished"}
    assert rows["episode_return"].tolist() == [-7.0 if outcome == "crash" else 0.0 for outcome in rows["outcome"]]


class LeftOfTheLine(CenterlineFollower):
    """Passes those who keep to the centreline."""

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return super().act({**observation, "frenet": observation["frenet"] - np.array([1.2, 0.0])})


def test_overtakes_are_counted():
    task = SLIPPERY.model_copy(
        update={
            "num_cars": 2,
            "opponent_speed": (0.3, 0.6),
            "start": StartConfig(offset=0.0, heading_error=0.0, gap=(5.0, 8.0)),
            "vehicle": VehicleParams(v_max=8.0),
            "termination": TerminationConfig(time_limit=6.0),
            "reward": RewardConfig(weights={"progress": 0.0, "steering_change": 0.0, "speed_change": 0.0}),
        }
    )
    driver: Any = LeftOfTheLine(speed_action=0.0)
    rows = evaluate(driver, task, [ring(radius=8.0, half_width=2.5)], episodes=12, seed=0)
    assert rows["outcome"].tolist() == ["timeout"] * 12
    assert rows["opponent_1_speed_mps"].between(0.3, 0.6).all()
    # Who starts behind the slower car passes it once, who starts ahead never does; the order of starts is random.
    assert set(rows["overtakes"]) == {0, 1}
    assert rows["places_lost"].tolist() == [0] * 12
    assert rows["episode_return"].tolist() == rows["overtakes"].tolist()  # the one reward that is left


def test_a_track_is_never_raced_another_way_round():
    task = SLIPPERY.model_copy(update={"augment_tracks": True, "termination": TerminationConfig(time_limit=1.0)})
    plain = SLIPPERY.model_copy(update={"termination": TerminationConfig(time_limit=1.0)})
    augmented, as_it_is = (evaluate(follower(), each, [LARGE], episodes=6, seed=0) for each in (task, plain))
    assert_frame_equal(augmented, as_it_is, check_exact=True)


def test_standing_starts_keep_the_task_and_replace_start_and_end():
    task = standing_starts(SLIPPERY, [LARGE, SMALL], laps=2)
    assert task.tracks == ("ring5", "ring4")
    assert (task.vehicle, task.lidar, task.reward) == (SLIPPERY.vehicle, SLIPPERY.lidar, SLIPPERY.reward)
    assert task.termination.laps == 2
    assert task.termination.time_limit == pytest.approx(3 * 2 * 3.14159 * 5.0, rel=1e-3)  # at 1 m/s
    assert standing_starts(SLIPPERY, [LARGE], laps=0, time_limit=5.0).termination.time_limit == 5.0
    rows = evaluate(follower(), standing_starts(SLIPPERY, [LARGE], 0, 0.08), [LARGE], episodes=12, seed=0)
    assert max(rows["mean_speed_mps"]) < 9.51 * 0.08 + 1e-6  # a_max for 0.08 s from a standstill
    assert rows["outcome"].tolist() == ["timeout"] * 12
    assert np.ptp(rows["start_m"]) > 0.5 * LARGE.centerline.length


def test_progress_grows_to_the_end():
    seen = []
    evaluate(follower(), SLIPPERY, [LARGE, SMALL], episodes=3, seed=0, num_worlds=2, on_progress=seen.append)
    assert {each.total for each in seen} == {6}
    done = [each.done for each in seen]
    assert all(later >= earlier - 1e-9 for earlier, later in pairwise(done))
    assert all(each.done < 6 for each in seen[:-1])
    assert (seen[-1].finished, seen[-1].done) == (6, 6)


def test_steps_count_those_of_the_episodes():
    seen = []
    found = evaluate(follower(), SLIPPERY, [LARGE], episodes=5, seed=5, num_worlds=3, on_progress=seen.append)
    assert seen[-1].steps == found["episode_steps"].sum()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tracks": []}, "tracks: none"),
        ({"tracks": [LARGE, ring(radius=5.0)]}, "ring5 is named twice"),
        ({"episodes": 0}, "episodes is 0"),
        ({"num_worlds": 0}, "num_worlds is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"tracks": ["Nowhere"]}, "Nowhere"),
    ],
)
def test_mistakes_are_named(changes, message):
    arguments: dict[str, Any] = {"tracks": [LARGE], "episodes": 1, "seed": 0, **changes}
    with pytest.raises(OutlapError, match=message):
        evaluate(follower(), SLIPPERY, **arguments)


def test_an_episode_without_end_is_refused():
    endless = SLIPPERY.model_copy(update={"termination": TerminationConfig(time_limit=0.0)})
    with pytest.raises(OutlapError, match="may never end"):
        evaluate(follower(), endless, [LARGE], episodes=1, seed=0)
    with pytest.raises(OutlapError, match="time limit is needed"):
        standing_starts(SLIPPERY, [LARGE], laps=0)


def test_a_policy_is_not_shown_what_it_was_not_trained_on(policy):
    task = SLIPPERY.model_copy(update={"beams": 20})
    with pytest.raises(OutlapError, match="trained on 12 numbers of 'scan' and would be shown 20"):
        evaluate(policy, task, [LARGE], episodes=1, seed=0)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.full((2, 2), np.nan), r"driver broken: gave the action \[nan, nan\]; must be finite"),
        (np.zeros((2, 3)), r"driver broken: gave actions of shape \(2, 3\); must be \(2, 2\)"),
        ([["a"]], r"driver broken: gave \[\['a'\]\]; must be numbers \(2, 2\)"),
    ],
)
def test_a_driver_that_gives_nonsense_is_named(answer, message) -> None:
    def broken(observation):
        return answer

    track = ring()
    with pytest.raises(OutlapError, match=message):
        evaluate(FunctionDriver(broken, "broken", ("frenet",)), standing_starts(RaceConfig(), [track]), [track], 2, 0)


def test_a_lap_is_compared_with_the_least_time_of_that_very_car(rows):
    """A car with more grip could lap faster: the same lap is then farther from the limit."""
    lapped = rows[rows["completed_laps"] > 0]
    assert len(lapped) > 3
    np.testing.assert_allclose(lapped["lap_time_ratio"], lapped["lap_time_s"] / lapped["min_lap_time_s"])
    assert lapped["lap_time_ratio"].min() > 1.0
    assert np.isnan(rows.loc[rows["completed_laps"] == 0, ["lap_time_ratio", "min_lap_time_s"]].to_numpy()).all()
    for track, group in lapped.groupby("track"):
        by_grip = group.sort_values("vehicle_mu")["min_lap_time_s"].to_numpy()
        assert (np.diff(by_grip) <= 1e-9).all(), track
    # On a circle of radius r inside: 2 pi sqrt(r / (mu g)); walls 0.8 m from a radius of 5 m.
    large = lapped[lapped["track"] == "ring5"]
    inside = 5.0 - 0.8 + 0.155 + DEFAULT_MARGIN
    expected = 2.0 * np.pi * np.sqrt(inside / (9.81 * large["vehicle_mu"]))
    np.testing.assert_allclose(large["min_lap_time_s"], expected, rtol=0.015)
    assert 0.0 <= lapped["min_lap_error"].min() <= lapped["min_lap_error"].max() < 0.01


def test_no_yardstick_is_asked_for_or_can_be_planned(caplog, monkeypatch):
    """What was raced counts all the same, and it is said why the ratio is missing."""
    alone = evaluate(follower(), SLIPPERY, [SMALL], episodes=2, seed=5, lap_time_ratios=False)
    assert np.isnan(alone["lap_time_ratio"].to_numpy()).all()

    def fail(*_: Any) -> None:
        raise OutlapError("track ring5: at s = 1.0 m it is narrower than the car")

    monkeypatch.setattr(rollout, "min_laps", fail)
    rows = evaluate(follower(), SLIPPERY, [LARGE], episodes=6, seed=5)
    assert rows["completed_laps"].to_numpy().max() > 0
    assert np.isnan(rows["lap_time_ratio"].to_numpy()).all()
    assert "no lap_time_ratio: track ring5: at s = " in caplog.text


class Listener(Driver):
    """Drives like the follower, and keeps what it hears of rewards."""

    name = "listener"

    def __init__(self, reward: RewardConfig | None) -> None:
        self.follower, self.reward = follower(), reward
        self.observation_terms = (*self.follower.observation_terms, "previous_reward")
        self.heard: list[float] = []

    def begin(self, cars: np.ndarray) -> None:
        self.follower.begin(cars)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.heard.append(float(observation["previous_reward"][0, 0]))
        return self.follower.act(observation)


def test_a_driver_hears_the_rewards_of_its_training_and_is_told_of_in_the_tasks():
    task = SLIPPERY.model_copy(update={"reward": RewardConfig(preset="paper", collision_max=1.0)})
    task = standing_starts(task, [LARGE], laps=1)
    fast, native = Listener(RewardConfig()), Listener(None)
    rows, plain = (evaluate(each, task, [LARGE], 1, 5) for each in (fast, native))
    # The same drive, scored alike to rounding, by a reward that only one of them heard.
    assert rows["episode_steps"].tolist() == plain["episode_steps"].tolist()
    for column in ("episode_return", "last_reward"):
        np.testing.assert_allclose(rows[column].to_numpy(), plain[column].to_numpy(), rtol=1e-9)
    own = evaluate(Listener(None), task.model_copy(update={"reward": RewardConfig()}), [LARGE], 1, 5)
    assert sum(native.heard) == pytest.approx(plain["episode_return"][0] - plain["last_reward"][0], rel=1e-5)
    assert sum(fast.heard) == pytest.approx(own["episode_return"][0] - own["last_reward"][0], rel=1e-5)
    assert abs(sum(fast.heard) - sum(native.heard)) > 1.0
