"""terminated, truncated and the outcome of every way in which an episode can end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from outlap.envs.keywords import make_race_vector
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError

STANDSTILL = -0.6  # the speed action that stands for 0 m/s between -5 and 20


def finish(env: RaceVectorEnv, action: Any, limit: int = 3000) -> tuple[str, bool, bool, float]:
    """Step one world until its episode ends: outcome, terminated, truncated, its time [s]."""
    for _ in range(limit):
        now: Any = action(env) if callable(action) else np.array([action])
        _, _, terminated, truncated, info = env.step(now)
        if terminated[0] or truncated[0]:
            final = info["final_info"]
            return str(final["outcome"][0]), bool(terminated[0]), bool(truncated[0]), float(final["time_s"][0])
        assert info["outcome"][0] == ""
    raise AssertionError("the episode does not end")


def test_a_crash_into_the_wall_terminates(ellipse, put):
    env = make_race_vector(1, tracks=[ellipse], beams=0)
    put(env, [0.0, 0.0, 1.4, 5.0])
    outcome, terminated, truncated, time = finish(env, [0.0, -0.2])
    assert (outcome, terminated, truncated) == ("crash", True, False)
    # 1.1 m to the wall less half a car, at 5 m/s nearly across
    assert time == pytest.approx((1.1 - 0.29) / 5.0 / np.sin(1.4), abs=0.03)


def test_a_crash_into_a_car_terminates(ellipse, put):
    env = make_race_vector(1, tracks=[ellipse], num_cars=2, beams=0, opponent_speed=0.0)
    put(env, np.array([[0.0, 0.0, 0.0, 5.0], [1.5, 0.0, 0.0, 0.0]]))
    outcome, terminated, truncated, time = finish(env, [0.0, -0.2])
    assert (outcome, terminated, truncated) == ("crash", True, False)
    assert time == pytest.approx((1.5 - 0.58) / 5.0, abs=0.03)


def test_an_opponents_crash_ends_nothing(ellipse, put):
    env = make_race_vector(
        1, tracks=[ellipse], num_cars=2, beams=0, opponent_speed=3.0, termination={"stall_time": 0.0}
    )
    put(env, np.array([[0.0, 0.0, 0.0, 0.0], [20.0, 0.0, 1.5, 3.0]]))
    for _ in range(100):
        _, _, terminated, truncated, info = env.step(np.array([[0.0, STANDSTILL]]))
        assert not (terminated | truncated).any()
    assert env.race.worlds.contact[0, 1], "the test needs an opponent that crashes"
    assert info["outcome"][0] == ""


def test_the_time_limit_truncates(ellipse, put, follow):
    env = make_race_vector(1, tracks=[ellipse], beams=0, termination={"time_limit": 1.5})
    put(env, [0.0, 0.0, 0.0, 2.0])
    assert finish(env, lambda env: follow(env, -0.5)) == ("timeout", False, True, pytest.approx(1.5))


@pytest.mark.parametrize("interval", [1, 4, 7])
def test_the_time_limit_counts_physics_time(ellipse, put, follow, interval):
    """Not environment steps: the first decision at or after the limit is the last."""
    env = make_race_vector(1, tracks=[ellipse], beams=0, control_interval=interval, termination={"time_limit": 0.6})
    put(env, [0.0, 0.0, 0.0, 2.0])
    time = finish(env, lambda env: follow(env, -0.5))[-1]
    assert time == pytest.approx(-(-60 // interval) * interval * 0.01)


@pytest.mark.parametrize("laps", [1, 2])
def test_laps_done_truncate(circle, put, follow, laps):
    """From the line to the line; the stretch before the first crossing is the out-lap."""
    env = make_race_vector(1, tracks=[circle], beams=0, control_interval=2, termination={"laps": laps})
    length = circle.centerline.length
    put(env, [length - 2.0, 0.0, 0.0, 5.0])
    driven = [0.0]

    def go(env: RaceVectorEnv) -> np.ndarray:
        driven.append(env.race.distance[0, 0] - env.race.start[0, 0])
        return follow(env, -0.2)

    outcome, terminated, truncated, _ = finish(env, go)
    assert (outcome, terminated, truncated) == ("finished", False, True)
    step = driven[-1] - driven[-2]
    assert driven[-1] < 2.0 + laps * length < driven[-1] + 1.1 * step


@pytest.mark.parametrize(
    ("speed", "speed_action"),
    [(0.0, STANDSTILL), (-1.0, STANDSTILL - 0.08), (0.0, STANDSTILL + 0.005)],
    ids=["stands", "reverses", "creeps"],
)
def test_no_new_ground_is_a_stall(big_circle, put, speed, speed_action):
    """0.3 m of new ground are asked for within 3 s; creeping at 6 cm/s is not enough."""
    env = make_race_vector(1, tracks=[big_circle], beams=0)
    put(env, [5.0, 0.0, 0.0, speed])
    steer = 0.098  # the circle's
    assert finish(env, [steer, speed_action]) == ("stalled", False, True, pytest.approx(3.0))


def test_driving_to_and_fro_is_a_stall(big_circle, put):
    """Ground that was reached before does not count."""
    env = make_race_vector(1, tracks=[big_circle], beams=0, termination={"stall_time": 4.0})
    put(env, [5.0, 0.0, 0.0, 0.0])
    forwards, backwards = STANDSTILL + 0.08, STANDSTILL - 0.08

    def to_and_fro(env: RaceVectorEnv) -> np.ndarray:
        phase = env.race.worlds.time[0] % 2.0
        return np.array([[0.098, forwards if phase < 0.8 else backwards]])

    outcome, terminated, truncated, time = finish(env, to_and_fro)
    assert (outcome, terminated, truncated) == ("stalled", False, True)
    assert 4.0 < time < 5.0


def test_a_slow_car_that_gets_ahead_does_not_stall(big_circle, put):
    env = make_race_vector(1, tracks=[big_circle], beams=0, termination={"time_limit": 8.0})
    put(env, [5.0, 0.0, 0.0, 0.2])
    assert finish(env, [0.098, STANDSTILL + 0.016])[0] == "timeout"  # 0.2 m/s: 0.3 m take 1.5 s


def test_rules_can_be_switched_off(ellipse, put):
    limits = {"time_limit": 0, "stall_time": 0}
    env = make_race_vector(1, tracks=[ellipse], beams=0, control_interval=50, termination=limits)
    put(env, [0.0, 0.0, 0.0, 0.0])
    for _ in range(200):
        _, _, terminated, truncated, info = env.step(np.array([[0.0, STANDSTILL]]))
        assert not (terminated | truncated).any()
    assert info["time_s"][0] == pytest.approx(100.0)


def test_a_crash_at_the_time_limit_is_a_crash_and_never_both(ellipse, put):
    """Bootstrapping through a crash was the original's mistake."""
    env = make_race_vector(1, tracks=[ellipse], beams=0)
    put(env, [0.0, 0.0, 1.4, 5.0])
    time = finish(env, [0.0, -0.2])[-1]
    env = make_race_vector(1, tracks=[ellipse], beams=0, termination={"time_limit": time})
    put(env, [0.0, 0.0, 1.4, 5.0])
    assert finish(env, [0.0, -0.2]) == ("crash", True, False, pytest.approx(time))


def test_the_flags_are_never_both_set_and_tell_the_outcome(ellipse, circle):
    """Many worlds, random driving: crash ⇔ terminated, every other outcome ⇔ truncated, none ⇔ neither."""
    env = make_race_vector(
        16, tracks=[ellipse, circle], beams=0, control_interval=5, start={"speed": (0.0, 6.0)},
        termination={"time_limit": 1.2, "stall_time": 0.6, "stall_distance": 0.5},
    )  # fmt: skip
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(100):
        _, _, terminated, truncated, info = env.step(rng.uniform(-1.0, [1.0, 0.0], (16, 2)))
        assert not (terminated & truncated).any()
        over = terminated | truncated
        if over.any():
            outcome = info["final_info"]["outcome"]
            np.testing.assert_array_equal(terminated, outcome == "crash")
            np.testing.assert_array_equal(over, outcome != "")
            seen |= set(outcome[over])
    assert seen == {"crash", "timeout", "stalled"}


@pytest.mark.parametrize(
    ("field", "value"), [("time_limit", -1), ("laps", -1), ("laps", 1.5), ("stall_time", -0.1), ("stall_distance", 0)]
)
def test_wrong_values_are_refused(ellipse, field, value):
    with pytest.raises(OutlapError, match=f"termination.{field}"):
        make_race_vector(1, tracks=[ellipse], beams=0, termination={field: value})
