"""Opponents from populations, as objects and as functions: who drives, what each is shown, how fast it may go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from outlap.drivers.classical import PurePursuit
from outlap.drivers.population import load_population
from outlap.envs.keywords import make_race_vector
from outlap.envs.observations import observe
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError
from outlap.track.track import Track
from small_populations import driver, population, ring_driver

APART = {"gap": (6.0, 6.0), "speed": 1.0}
ENDLESS = {"stall_time": 0.0, "time_limit": 0.0}
NUM_ENVS = 16
PAST = 9.51 * 0.01  # [m/s] by which a car passes its v_max: a step of full acceleration
STILL = np.tile([0.0, -1.0], (NUM_ENVS, 1))


def race(track: Track, opponents: Any, **config: Any) -> RaceVectorEnv:
    """An environment against these opponents, begun."""
    settings = {"num_cars": 3, "beams": 24, "speed_range": (0.0, 6.0), "start": APART, "termination": ENDLESS}
    env = make_race_vector(NUM_ENVS, tracks=[track], opponents=opponents, **{**settings, **config})
    env.reset(seed=0)
    return env


def drawn(env: RaceVectorEnv, resets: int = 3) -> set[str]:
    """The drivers that some episodes are against."""
    return {name for _ in range(resets) for name in env.reset()[1]["opponents"].ravel()}


def straight(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.tile([0.0, -0.8], (len(observation["vel"]), 1))


def test_a_populations_folder_gives_opponents_of_its_training_half(big_circle, tmp_path: Path) -> None:
    folder = population(tmp_path, "train", "held_out", "train")
    env = race(big_circle, str(folder))
    assert [driver.name for driver in env.opponents.drivers] == ["ring-2.0", "ring-4.0"]
    assert drawn(env) == {"ring-2.0", "ring-4.0"}
    assert env.config.opponents == (str(folder),)
    assert drawn(race(big_circle, folder, opponent_split="held_out")) == {"ring-3.0"}


def test_a_held_out_member_is_no_opponent_in_training(big_circle, tmp_path: Path) -> None:
    member = population(tmp_path, "train", "held_out") / "ring-3.0"
    with pytest.raises(OutlapError, match=r"ring-3\.0: is held out"):
        race(big_circle, [member])
    assert drawn(race(big_circle, [member], opponent_split="held_out")) == {"ring-3.0"}


def test_each_car_gets_the_action_of_the_member_that_drives_it(big_circle, tmp_path: Path) -> None:
    folder = population(tmp_path, "train", "train", "train")
    env = race(big_circle, folder)
    members = {each.name: each for each in load_population(folder)}
    for _ in range(3):
        names = env.opponents.names()
        assert len(set(names.ravel())) == 3
        expected = np.empty((NUM_ENVS, 2, 2))
        for car in (1, 2):
            seen = observe(env.race, car, ("scan", "vel", "heading"), True)
            told = {name: each.act(seen) for name, each in members.items()}
            expected[:, car - 1] = [told[name][world] for world, name in enumerate(names[:, car - 1])]
        env.step(STILL)
        np.testing.assert_allclose(env.race.actions[:, 1:], expected, atol=1e-6)
        env.reset()


def test_a_scan_of_more_beams_is_thinned_to_those_nearest_to_the_drivers_own(big_circle) -> None:
    looks = driver(3)
    env = race(big_circle, looks, num_cars=2, beams=60, field_of_view=4.0)
    own, offered = np.linspace(-2.0, 2.0, 24), np.linspace(-2.0, 2.0, 60)
    nearest = np.abs(own[:, None] - offered).argmin(axis=1)
    seen = observe(env.race, 1, looks.observation_terms, True)
    expected = looks.act({**seen, "scan": seen["scan"][:, nearest]})
    assert np.ptp(expected[:, 0]) > 0.1
    env.step(STILL)
    np.testing.assert_allclose(env.race.actions[:, 1], expected, atol=1e-6)
    assert env.observe(0)["scan"].shape == (NUM_ENVS, 60)


def test_a_driver_of_more_beams_than_the_cars_have_is_named(big_circle) -> None:
    with pytest.raises(OutlapError, match="driver keen: looks with 36 beams, and the cars have 24; set beams to 36"):
        race(big_circle, [driver(), driver(1, "keen", beams=36)])


def test_a_members_actions_command_its_own_speeds(big_circle) -> None:
    """Whatever the actions of the ego command, and never more than the car can do."""
    rivals = [
        ring_driver(8.0, "crawler", speed_action=-1.0, speeds=(1.2, 4.0)),
        ring_driver(8.0, "runner", speed_action=1.0, speeds=(0.5, 2.5)),
        ring_driver(8.0, "racer", speed_action=1.0, speeds=(0.5, 7.0)),
    ]
    env = race(big_circle, rivals, control_interval=4, num_cars=2, vehicle={"v_max": 3.0})
    _, info = env.reset(seed=0)
    driven = {"crawler": 1.2, "runner": 2.5, "racer": 3.0}
    fastest = {"crawler": 3.0, "runner": 2.5, "racer": 3.0}
    names = info["opponents"][:, 0]
    assert set(names) == set(driven)
    np.testing.assert_allclose(info["opponent_speed_mps"][:, 0], [fastest[name] for name in names])
    for _ in range(50):
        env.step(STILL)
    np.testing.assert_allclose(env.race.speed[:, 1], [driven[name] for name in names], atol=PAST)


def test_a_drawn_top_speed_holds_a_member_back(big_circle) -> None:
    env = race(
        big_circle, ring_driver(8.0, speed_action=1.0, speeds=(0.5, 4.0)), control_interval=4, num_cars=2,
        opponent_speed=(1.0, 2.0),
    )  # fmt: skip
    _, info = env.reset(seed=0)
    top = info["opponent_speed_mps"][:, 0]
    assert np.ptp(top) > 0.5
    assert (top.min() >= 1.0) & (top.max() <= 2.0)
    for _ in range(50):
        env.step(STILL)
    np.testing.assert_allclose(env.race.speed[:, 1], top, atol=PAST)


def test_opponents_are_objects_and_functions_too_and_the_configuration_has_their_names(big_circle) -> None:
    env = race(big_circle, [PurePursuit(speed_share=0.5, name="slow"), straight, driver(name="looker"), "pure-pursuit"])
    assert env.config.opponents == ("slow", "straight", "looker", "pure-pursuit")
    assert drawn(env) == {"slow", "straight", "looker", "pure-pursuit"}
    names = env.opponents.names()
    env.step(STILL)
    its_own = env.race.actions[:, 1:][names == "straight"]
    np.testing.assert_allclose(its_own, np.tile([0.0, -0.8], (len(its_own), 1)), atol=1e-6)
    assert race(big_circle, straight).config.opponents == ("straight",)


def test_a_function_is_shown_all_opponents_at_once_in_the_terms_that_it_names(big_circle) -> None:
    shown = []

    def watch(observation: dict[str, np.ndarray]) -> np.ndarray:
        shown.append(observation)
        return np.zeros((len(observation["frenet"]), 2))

    watch.observation_terms = ("frenet", "scan")  # type: ignore[attr-defined]
    env = race(big_circle, watch)
    expected = [observe(env.race, car, ("frenet", "scan"), False) for car in (1, 2)]
    env.step(STILL)
    (observation,) = shown
    assert {name: value.shape for name, value in observation.items()} == {"frenet": (32, 2), "scan": (32, 24)}
    for name, value in observation.items():
        for car in (0, 1):
            np.testing.assert_array_equal(value[car::2], expected[car][name])


def test_the_info_names_opponents_and_task(big_circle) -> None:
    env = race(big_circle, [PurePursuit(name="b"), PurePursuit(name="a")])
    _, info = env.reset(seed=1)
    assert info["opponents"].shape == (NUM_ENVS, 2)
    expected = [f"ring8 against {', '.join(sorted(names))}" for names in info["opponents"]]
    assert info["task"].tolist() == expected
    assert set(expected) == {"ring8 against a, a", "ring8 against a, b", "ring8 against b, b"}
    alone = make_race_vector(2, tracks=[big_circle], beams=0)
    _, info = alone.reset(seed=0)
    assert info["task"].tolist() == ["ring8", "ring8"]
    assert info["opponents"].shape == (2, 0)


def test_the_episode_that_ended_has_its_own_opponents_in_its_summary(circle) -> None:
    rivals = [PurePursuit(name="a"), PurePursuit(name="b")]
    env = race(circle, rivals, num_cars=2, start={"gap": (4.0, 4.0)}, termination={"time_limit": 0.05})
    _, info = env.reset(seed=0)
    before = info["opponents"]
    for _ in range(5):
        *_, truncated, info = env.step(STILL)
    assert truncated.all()
    np.testing.assert_array_equal(info["final_info"]["opponents"], before)
    assert (info["opponents"] != before).any()


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.full((32, 2), np.nan), r"driver broken: gave the action \[nan, nan\]; must be finite"),
        (np.zeros((32, 3)), r"driver broken: gave actions of shape \(32, 3\); must be \(32, 2\)"),
        (np.zeros(2), r"driver broken: gave actions of shape \(2,\); must be \(32, 2\)"),
        (None, r"driver broken: gave None; must be numbers \(32, 2\)"),
    ],
    ids=["nan", "three numbers", "one car", "nothing"],
)
def test_a_function_that_gives_nonsense_is_named(big_circle, answer: Any, message: str) -> None:
    def broken(observation: dict[str, np.ndarray]) -> np.ndarray:
        return answer

    with pytest.raises(OutlapError, match=message):
        race(big_circle, [broken]).step(STILL)


def test_a_function_of_unknown_terms_is_named(big_circle) -> None:
    def psychic(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.zeros((len(observation["future"]), 2))

    psychic.observation_terms = ("future",)  # type: ignore[attr-defined]
    with pytest.raises(OutlapError, match="driver psychic: observes 'future'; must be one of scan"):
        race(big_circle, [psychic])


@pytest.mark.parametrize("opponents", [["stig"], [3], [PurePursuit]])
def test_what_is_no_opponent_is_named(big_circle, opponents: Any) -> None:
    with pytest.raises(OutlapError, match=r"driver is ('stig'|3|<class .*PurePursuit'>); must be"):
        race(big_circle, opponents)
