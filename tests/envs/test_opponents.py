"""Who drives the other cars, and how."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.drivers import Driver
from outlap.envs.keywords import make_race_vector
from outlap.errors import OutlapError


class Scripted(Driver):
    """Always the same action; notes what it was asked."""

    observation_terms = ("frenet",)

    def __init__(self, name: str, action) -> None:
        self.name, self.action = name, action
        self.begun: list[np.ndarray] = []
        self.asked = 0

    def begin(self, cars: np.ndarray) -> None:
        self.begun.append(cars.copy())

    def act(self, observation) -> np.ndarray:
        self.asked += 1
        return np.tile(np.asarray(self.action, np.float32), (len(observation["frenet"]), 1))


def field(track, *drivers, num_envs: int = 64, num_cars: int = 3, noise=0.0, speed=(1.0, 3.0), seed: int = 0):
    """An environment whose opponents are these drivers."""
    env = make_race_vector(
        num_envs, tracks=[track], num_cars=num_cars, beams=0, termination={"stall_time": 0.0, "time_limit": 0.0},
        start={"gap": (6.0, 6.0)}, opponents=drivers, opponent_speed=speed, opponent_noise=noise,
    )  # fmt: skip
    env.reset(seed=seed)
    return env


def test_every_driver_drives_its_own_cars_and_is_asked_once_a_step(big_circle):
    left, right = Scripted("left", (0.5, -1.0)), Scripted("right", (-0.5, -1.0))
    env = field(big_circle, left, right)
    number = env.opponents.number.copy()
    assert 0.3 < number.mean() < 0.7
    env.step(np.zeros((64, 2)))
    np.testing.assert_array_equal(env.race.actions[:, 1:, 0], np.where(number == 0, 0.5, -0.5))
    assert (left.asked, right.asked) == (1, 1)


def test_drivers_and_speeds_are_drawn_anew_at_a_reset_and_repeat_with_the_seed(big_circle):
    drivers = [Scripted(name, (0.0, -1.0)) for name in "abc"]
    env = field(big_circle, *drivers)
    first = env.opponents.number.copy(), env.opponents.top_speed.copy()
    assert set(np.unique(first[0])) == {0, 1, 2}
    assert first[1].min() >= 1.0
    assert first[1].max() <= 3.0
    env.reset()
    assert (env.opponents.number != first[0]).any()
    again = field(big_circle, *drivers)
    np.testing.assert_array_equal(again.opponents.number, first[0])
    np.testing.assert_array_equal(again.opponents.top_speed, first[1])


def test_a_driver_hears_whose_episode_begins(big_circle):
    driver = Scripted("one", (0.0, -1.0))
    env = field(big_circle, driver, num_envs=4)
    for _ in range(2):
        env.step(np.zeros((4, 2)))
    env.reset(options={"reset_mask": np.array([False, True, False, False])})
    env.step(np.zeros((4, 2)))
    expected = [[True] * 4, [False] * 4, [False, True, False, False]]
    for told, worlds in zip(driver.begun, expected, strict=True):
        np.testing.assert_array_equal(told.reshape(4, 2), np.tile(worlds, (2, 1)).T)


def test_noise_is_as_large_as_drawn_differs_between_steps_and_repeats_with_the_seed(big_circle):
    def actions(noise) -> np.ndarray:
        env = field(big_circle, Scripted("calm", (0.0, -0.5)), noise=noise)
        seen = []
        for _ in range(20):
            env.race.worlds.contact[:] = 0
            env._over[:] = False
            env.step(np.zeros((64, 2)))
            seen.append(env.race.actions[:, 1:].copy())
        return np.array(seen)

    noisy = actions(0.1)
    assert np.std(noisy - [0.0, -0.5]) == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef(noisy[:-1, :, :, 0].ravel(), noisy[1:, :, :, 0].ravel())[0, 1]) < 0.1
    np.testing.assert_array_equal(noisy, actions(0.1))
    np.testing.assert_array_equal(actions(0.0)[..., 0], 0.0)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ((0.0, float("nan")), r"driver bad: gave the action \[0\.0, nan\]"),
        ((0.0, 0.0, 0.0), r"driver bad: .* must be \(8, 2\)"),
    ],
)
def test_a_driver_that_gives_nonsense_is_named(big_circle, action, message):
    env = field(big_circle, Scripted("bad", action), num_envs=4)
    with pytest.raises(OutlapError, match=message):
        env.step(np.zeros((4, 2)))


def test_opponents_are_chosen_by_name(big_circle):
    env = make_race_vector(
        32, tracks=[big_circle], num_cars=3, beams=54, opponents=("pure-pursuit", "follow-the-gap"),
        opponent_speed=2.0, start={"gap": (6.0, 6.0)},
    )  # fmt: skip
    env.reset(seed=0)
    for _ in range(200):
        env.step(np.tile([0.1, -0.6], (32, 1)))
    assert {driver.name for driver in env.opponents.drivers} == {"pure-pursuit", "follow-the-gap"}
    driven = env.race.worlds.state[:, 1:, 3]
    assert np.median(driven) > 1.0
    with pytest.raises(OutlapError, match="driver is 'stig'"):
        make_race_vector(2, tracks=[big_circle], num_cars=2, opponents="stig")
