"""Drivers: the centreline follower laps a circuit; a policy acts as Stable-Baselines3 says, alone or in company."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from outlap.drivers.classical import CenterlineFollower
from outlap.drivers.policy import BATCH, PolicyDriver
from outlap.envs.observations import observation_space
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.simulator.vehicle import VehicleParams
from outlap.track import load_track
from outlap.track.generate import BUILTIN_HELD_OUT
from synthetic_tracks import ring
from untrained_policies import untrained_ppo

TASK = RaceConfig(
    beams=24,
    control_interval=4,
    speed_range=(0.0, 8.0),
    vehicle=VehicleParams(v_max=8.0),
    observation=("scan", "vel", "previous_action"),
    scale_observations=True,
)


@pytest.fixture(scope="module")
def model():
    return untrained_ppo(TASK, ring(), width=256)


@pytest.fixture
def observations(model) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    spaces = model.observation_space.spaces
    return {name: rng.normal(0, 1, (150, *box.shape)).astype(np.float32) for name, box in spaces.items()}


def space(**changes: Any):
    task = TASK.model_copy(update=changes)
    return observation_space(task.observation, task.beams, task.lidar.max_range, 3, task.scale_observations)  # type: ignore[arg-type]


def test_centerline_follower_laps_a_builtin_track():
    track = load_track(BUILTIN_HELD_OUT[-1])
    follower: Any = CenterlineFollower(speed_action=0.4)
    task = TASK.model_copy(update={"control_interval": 10})
    rows = evaluate(follower, standing_starts(task, [track], laps=1), [track], episodes=2, seed=0)
    assert rows["outcome"].tolist() == ["finished"] * 2
    # At most 0.7 of the range of speeds; less in corners, but not half as much.
    assert rows["mean_speed_mps"].between(0.5 * 5.6, 5.6).all()
    # Timed from line to line at the speed of the whole drive, on a path about as long as the centreline.
    np.testing.assert_allclose(rows["lap_time_s"], track.centerline.length / rows["mean_speed_mps"], rtol=0.05)


def test_a_policy_acts_as_its_model_predicts(model, observations):
    driver = PolicyDriver(model, scale_observations=True)
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(driver.act(observations), expected, atol=1e-5)
    assert driver.observation_terms == tuple(model.observation_space.spaces)
    assert np.ptp(expected, axis=0).min() > 0.1  # it does look


def test_an_action_does_not_depend_on_the_other_cars(model, observations):
    driver = PolicyDriver(model, scale_observations=True)
    together = driver.act(observations)
    rng = np.random.default_rng(1)
    for count in (1, 3, BATCH - 1, BATCH, BATCH + 1, 150):
        which = rng.permutation(150)[:count]
        some = driver.act({name: values[which] for name, values in observations.items()})
        np.testing.assert_array_equal(some, together[which])


def test_stochastic_actions_are_drawn_from_the_seed_and_from_nothing_else(model, observations):
    def two(seed: int) -> np.ndarray:
        driver = PolicyDriver(model, scale_observations=True, deterministic=False, seed=seed)
        return np.stack([driver.act(observations) for _ in range(2)])

    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = two(0)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    np.testing.assert_array_equal(two(0), first)
    assert not np.array_equal(two(1), first)
    assert not np.array_equal(first[0], first[1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"beams": 30}, "24 numbers of 'scan' and would be shown 30"),
        ({"observation": ("scan", "vel")}, "needs the observation 'previous_action'; there are scan, vel"),
        ({"scale_observations": False}, "'scan' with high = 3 and would be shown one with 30"),
    ],
)
def test_what_differs_from_training_is_named(model, changes, message):
    driver = PolicyDriver(model, scale_observations=True)
    driver.check(space())
    with pytest.raises(OutlapError, match=message):
        driver.check(space(**changes))


def test_wrong_observations_are_named(model, observations):
    driver = PolicyDriver(model, scale_observations=True)
    with pytest.raises(OutlapError, match=r"'vel' has shape \(150, 2\); must be \(150, 3\)"):
        driver.act({**observations, "vel": observations["vel"][:, :2]})
    del observations["vel"]
    with pytest.raises(OutlapError, match="needs the observation 'vel'"):
        driver.act(observations)
