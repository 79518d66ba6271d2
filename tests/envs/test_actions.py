"""Normalised actions and the commands that they mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from outlap.envs.actions import commands, speed_spans
from outlap.envs.keywords import make_race_vector
from outlap.simulator.vehicle import VehicleParams, parameter_bounds, to_records


def row(**changes: Any) -> np.ndarray:
    return to_records(parameter_bounds(VehicleParams(**changes))[0])


@pytest.mark.parametrize(
    ("steer", "angle"),
    [(-1.0, -0.2), (-0.5, -0.1), (0.0, 0.0), (0.5, 0.2), (1.0, 0.4)],
)
def test_the_stops_of_an_asymmetrical_steering_are_at_plus_and_minus_one(steer, angle):
    command = commands(np.array([steer, 0.0]), row(steer_min=-0.2, steer_max=0.4), np.array([0.0, 1.0]))
    assert command[0] == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize(
    ("speed_range", "low", "high"), [(None, -5.0, 20.0), ((1.0, 7.0), 1.0, 7.0), ((1.0, None), 1.0, 20.0)]
)
def test_the_second_number_spans_the_speed_range_or_the_cars_own(speed_range, low, high):
    actions = np.array([[0.0, -1.0], [0.0, 0.0], [0.0, 0.5], [0.0, 1.0]])
    params = np.full(4, row())
    command = commands(actions, params, speed_spans(params, speed_range))
    expected = [low, (low + high) / 2, low + 0.75 * (high - low), high]
    np.testing.assert_allclose(command[:, 1], expected, rtol=1e-6)
    np.testing.assert_array_equal(command[:, 0], 0.0)


def test_every_car_has_its_own_limits():
    params = np.stack([row(steer_max=0.3, v_min=-1.0, v_max=5.0), row(steer_max=0.5, v_min=0.0, v_max=9.0)])
    params = np.broadcast_to(params, (3, 2))
    command = commands(np.ones((3, 2, 2)), params, speed_spans(params, None))
    np.testing.assert_allclose(command, np.broadcast_to([[0.3, 5.0], [0.5, 9.0]], (3, 2, 2)), rtol=1e-6)
    assert command.dtype == np.float32


def test_steering_left_turns_left_and_full_speed_is_the_vehicles(big_circle, put):
    """End to end: action (1, 1) goes to the left stop; the car settles at v_max of the paper's vehicle."""
    env = make_race_vector(2, tracks=[big_circle], beams=0, vehicle="paper")
    put(env, [0.0, 0.0, 0.0, 7.9])
    yaw = env.race.worlds.state[:, 0, 4].copy()
    for _ in range(15):
        terminated = env.step(np.array([[1.0, 1.0], [-1.0, 1.0]]))[2]
        assert not terminated.any()
    steer, speed, turned = env.race.worlds.state[:, 0, [2, 3, 4]].T
    np.testing.assert_allclose(steer, [0.4189, -0.4189], rtol=1e-5)
    assert turned[0] - yaw[0] > 0.1
    assert turned[1] - yaw[1] < -0.1
    np.testing.assert_allclose(speed, 8.0, atol=0.1)


def test_actions_beyond_one_are_clipped(ellipse):
    envs = [make_race_vector(1, tracks=[ellipse], beams=0, observation="previous_action") for _ in range(2)]
    seen = []
    for env, action in zip(envs, ([[3.0, -7.0]], [[1.0, -1.0]]), strict=True):
        env.reset(seed=0)
        seen.append((env.step(np.array(action))[0]["previous_action"], env.race.worlds.state.copy()))
    np.testing.assert_array_equal(seen[0][0], [[1.0, -1.0]])
    np.testing.assert_array_equal(seen[0][1], seen[1][1])
