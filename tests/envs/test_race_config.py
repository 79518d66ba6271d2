"""RaceConfig: presets, ranges, and one clear line for whatever is wrong."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from outlap.config import load_config, save_config
from outlap.envs.keywords import make_race, make_race_vector
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import REWARD_PRESETS
from outlap.errors import OutlapError
from outlap.simulator.vehicle import to_records


def test_the_papers_vehicle(ellipse):
    """SYSTEM §1."""
    env = make_race_vector(1, tracks=[ellipse], beams=0, vehicle="paper")
    vehicle = env.config.vehicle.model_dump()
    expected = {
        "mu": 0.8, "C_Sf": 4.718, "C_Sr": 5.4562, "lf": 0.15875, "lr": 0.17145, "h": 0.074, "m": 3.74, "I": 0.04712,
        "width": 0.31, "length": 0.58, "steer_min": -0.4189, "steer_max": 0.4189, "steer_rate_max": 3.2,
        "a_max": 6.34, "v_switch": 7.319, "v_min": -8.0, "v_max": 8.0,
    }  # fmt: skip
    assert {name: vehicle[name] for name in expected} == expected
    _, info = env.reset(seed=0)
    car = to_records(info["vehicle"][0, 0])
    drawn = [float(car[name]) for name in ("mu", "a_max", "v_min", "v_max")]
    np.testing.assert_allclose(drawn, [0.8, 6.34, -8.0, 8.0], rtol=1e-6)


def test_a_preset_with_changes(ellipse):
    env = make_race_vector(
        64, tracks=[ellipse], beams=0,
        vehicle={"preset": "paper", "mu": {"min": 0.5, "max": 1.1}, "m": 4.0, "tyre": {"p_dy1": 0.9}},
    )  # fmt: skip
    _, info = env.reset(seed=0)
    cars = to_records(info["vehicle"][:, 0])
    for name, value in (("a_max", 6.34), ("v_max", 8.0), ("m", 4.0)):
        np.testing.assert_allclose(cars[name], value, rtol=1e-6)
    assert cars["mu"].min() >= 0.5
    assert cars["mu"].max() <= np.float32(1.1)
    assert len(np.unique(cars["mu"])) == 64
    assert env.config.vehicle.mu == (0.5, 1.1)
    assert env.config.vehicle.tyre.p_dy1 == 0.9


def test_the_default_vehicle_is_the_f1tenth_gyms(ellipse):
    vehicle = make_race_vector(1, tracks=[ellipse], beams=0).config.vehicle
    assert (vehicle.mu, vehicle.a_max, vehicle.v_min, vehicle.v_max) == (1.0489, 9.51, -5.0, 20.0)


def test_the_papers_reward_by_name(ellipse):
    by_name = make_race_vector(1, tracks=[ellipse], beams=0, reward="paper").config.reward
    assert by_name == make_race_vector(1, tracks=[ellipse], beams=0, reward={"preset": "paper"}).config.reward
    assert by_name.resolved() == {name: w for name, w in REWARD_PRESETS["paper"].items() if w}


def test_it_survives_a_file(tmp_path):
    fields = {
        "tracks": ("IMS", "Monza"),
        "num_cars": 3,
        "vehicle": {"preset": "paper", "mu": {"min": 0.5, "max": 1.1}},
        "reward": "paper",
        "speed_range": (0.0, 8.0),
        "lidar": {"noise_std": (0.0, 0.1)},
        "opponent_speed": (2.0, 6.0),
        "observation": ("scan", "vel"),
        "start": {"anywhere": False},
        "termination": {"laps": 3},
    }
    config = RaceConfig.model_validate(fields)
    assert load_config(RaceConfig, save_config(config, tmp_path / "race.yaml")) == config


def test_a_saved_configuration_makes_the_same_environment(ellipse, circle):
    """Its dump as keywords: same draws, same observations."""
    first = make_race_vector(
        3, tracks=[ellipse, circle], beams=5, vehicle={"preset": "paper", "mu": (0.5, 1.1)}, lidar={"noise_std": 0.1}
    )
    keywords: Any = first.config.model_dump(mode="json") | {"tracks": [ellipse, circle]}
    second = make_race_vector(3, **keywords)
    a, b = first.reset(seed=1)[0], second.reset(seed=1)[0]
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


WRONG = [
    ({"beam": 5}, "beam is not a known field; did you mean beams"),
    ({"beams": -1}, "beams is -1"),
    ({"beams": 1081}, "beams is 1081"),
    ({"beams": "many"}, "beams is 'many'"),
    ({"num_cars": 0}, "num_cars is 0"),
    ({"num_cars": 2.5}, "num_cars is 2.5"),
    ({"control_interval": 0}, "control_interval is 0"),
    ({"control_interval": True}, "control_interval is True"),
    ({"timestep": 0.0}, "timestep is 0"),
    ({"timestep": -0.01}, "timestep is -0.01"),
    ({"timestep": 1.0}, "timestep is 1.0"),
    ({"timestep": float("nan")}, "timestep is nan"),
    ({"substeps": 0}, "substeps is 0"),
    ({"field_of_view": 7.0}, "field_of_view is 7.0"),
    ({"model": "rocket"}, "model is 'rocket'.*single_track"),
    ({"integrator": "rk5"}, "integrator is 'rk5'.*did you mean 'rk4'"),
    ({"speed_range": (8.0, 0.0)}, "speed_range.*slowest < fastest"),
    ({"speed_range": (1.0,)}, "speed_range"),
    ({"speed_range": 8.0}, "speed_range"),
    ({"opponent_speed": -1.0}, "opponent_speed is -1.0; must be >= 0"),
    ({"opponent_speed": (3.0, 1.0)}, "opponent_speed.*min <= max"),
    ({"vehicle": "lorry"}, "vehicle.*'lorry'.*f1tenth, paper"),
    ({"vehicle": {"preset": "lorry"}}, "vehicle.*'lorry'.*f1tenth, paper"),
    ({"vehicle": {"preset": ["paper"]}}, "vehicle.*preset"),
    ({"vehicle": {"mu": -1.0}}, "vehicle.mu is -1.0; must be >= 0.01"),
    ({"vehicle": {"mu": {"min": 1.0, "max": 0.5}}}, "vehicle.mu.*min <= max"),
    ({"vehicle": {"mu": {"low": 1.0, "high": 0.5}}}, "vehicle.mu.*min and max"),
    ({"vehicle": {"mu": {"min": 0.0, "max": 0.5}}}, "vehicle.mu.*must be >= 0.01"),
    ({"vehicle": {"mass": 3.0}}, "vehicle.mass is not a known field"),
    ({"vehicle": {"preset": "paper", "friction": 3.0}}, "vehicle.friction is not a known field"),
    ({"vehicle": 3}, "vehicle is 3"),
    ({"actuators": {"steer_delay": -0.1}}, "actuators.steer_delay is -0.1"),
    ({"actuators": {"steer_delay": 100.0}}, "delay"),
    ({"lidar": {"dropout": 1.5}}, "lidar.dropout is 1.5"),
    ({"lidar": {"noise_std": -0.1}}, "lidar.noise_std is -0.1"),
    ({"observation": ("speed",)}, "observation.*'speed'"),
    ({"scale_observations": "perhaps"}, "scale_observations is 'perhaps'"),
    ({"termination": {"timelimit": 3}}, "termination.timelimit is not a known field; did you mean time_limit"),
    ({"render_mode": "ansi"}, "render_mode is 'ansi'"),
]


@pytest.mark.parametrize(("keywords", "words"), WRONG, ids=[str(keywords) for keywords, _ in WRONG])
def test_what_is_wrong_is_said_in_one_line(ellipse, keywords, words):
    """By the vector environment and the single one alike."""
    for make in (lambda **given: make_race_vector(2, **given), make_race):
        with pytest.raises(OutlapError, match=words) as caught:
            make(tracks=[ellipse], **({"beams": 0} | keywords))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("num_envs", [0, -1, 1.5, "two", None])
def test_a_wrong_number_of_worlds(ellipse, num_envs):
    with pytest.raises(OutlapError, match="num_envs is"):
        make_race_vector(num_envs, tracks=[ellipse], beams=0)


@pytest.mark.parametrize("mode", ["NextStep", "sometimes", gym.vector.AutoresetMode.NEXT_STEP, None])
def test_a_mode_of_autoreset_that_is_not_offered(ellipse, mode):
    with pytest.raises(OutlapError, match=r"autoreset_mode is .*SAME_STEP and DISABLED"):
        make_race_vector(1, tracks=[ellipse], beams=0, autoreset_mode=mode)


@pytest.mark.parametrize("name", ["num_envs", "autoreset_mode"])
def test_a_single_race_has_no_batch(ellipse, name):
    with pytest.raises(OutlapError, match=name):
        make_race(tracks=[ellipse], beams=0, **{name: 2})  # type: ignore[arg-type]
