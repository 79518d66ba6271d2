"""gymnasium.make and make_vec, and Gymnasium's own checks."""

from __future__ import annotations

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics

from outlap.drivers.classical import CenterlineFollower
from outlap.envs.episodes import EPISODE_FIELDS
from outlap.envs.keywords import make_race
from outlap.envs.race_env import RaceEnv
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.racing_line import LINE_SPEED
from outlap.errors import OutlapError
from outlap.simulator.atlas import FIRST_ROW, ROWS
from outlap.track.map_io import write_track

NAME = "outlap/Race-v0"
EVERYTHING = (
    "scan", "pose", "vel", "heading", "previous_action", "previous_reward", "frenet", "curvature_ahead", "line_ahead",
    "action_span",
)  # fmt: skip


def test_importing_outlap_registers_the_environment():
    """And nothing heavy: no torch, no Stable-Baselines3."""
    code = (
        "import sys, outlap, gymnasium; print(gymnasium.spec('outlap/Race-v0').id);"
        "print([name for name in ('torch', 'stable_baselines3', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == [NAME, "[]"]


def test_make_gives_a_single_race(ellipse):
    env = gym.make(NAME, tracks=[ellipse], num_cars=1, beams=12, control_interval=1)
    assert isinstance(env.unwrapped, RaceEnv)
    observation, info = env.reset(seed=0)
    assert {name: value.shape for name, value in observation.items()} == {
        "scan": (12,),
        "pose": (3,),
        "vel": (3,),
        "heading": (2,),
    }
    observation, reward, terminated, truncated, info = env.step(np.array([0.0, 1.0], np.float32))
    assert env.observation_space.contains(observation)
    assert [type(each) for each in (reward, terminated, truncated)] == [float, bool, bool]
    assert info["track"] == "ellipse"
    assert info["outcome"] == ""
    assert info["time_s"] == 0.01
    assert info["vehicle"].ndim == 2
    assert set(EPISODE_FIELDS) - {"lap_time_s"} < set(info)


def test_make_vec_takes_the_same_keywords(ellipse):
    """The line that others script against."""
    env = gym.make_vec(
        NAME,
        num_envs=256,
        vectorization_mode="vector_entry_point",
        tracks=[ellipse],
        num_cars=1,
        beams=540,
        control_interval=1,
    )
    assert isinstance(env.unwrapped, RaceVectorEnv)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    observation, _ = env.reset(seed=0)
    assert observation["scan"].shape == (256, 540)
    observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert reward.shape == terminated.shape == truncated.shape == (256,)
    assert terminated.dtype == truncated.dtype == bool
    assert isinstance(gym.make_vec(NAME, num_envs=2, tracks=[ellipse], beams=0).unwrapped, RaceVectorEnv)


def test_make_takes_tracks_by_name_and_folder(ellipse, tmp_path, monkeypatch):
    folder = write_track(ellipse, tmp_path / "ellipse")
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path))
    for tracks in (["ellipse"], "ellipse", [str(folder)]):
        assert gym.make(NAME, tracks=tracks, beams=0).reset(seed=0)[1]["track"] == "ellipse"


def test_a_wrong_keyword_of_make_is_named(ellipse):
    with pytest.raises(OutlapError, match="beam is not a known field"):
        gym.make(NAME, tracks=[ellipse], beam=3)
    with pytest.raises(OutlapError, match="beam is not a known field"):
        gym.make_vec(NAME, num_envs=2, vectorization_mode="vector_entry_point", tracks=[ellipse], beam=3)


@pytest.mark.parametrize(
    "config",
    [
        {},
        {"num_cars": 2, "observation": EVERYTHING, "scale_observations": True, "control_interval": 4},
        # Without the term whose curriculum makes the reward depend on how long training has gone on.
        {
            "beams": 0,
            "vehicle": {"mu": (0.5, 1.1)},
            "termination": {"time_limit": 0.02},
            "reward": {"preset": "paper", "weights": {"velocity_matching": 0.0}},
        },
    ],
    ids=["default", "everything", "short episodes"],
)
def test_gymnasiums_check_finds_nothing(ellipse, config):
    """No error, and no warning but the ones about bounds that do not exist (a pose, a speed)."""
    env = gym.make(NAME, **({"tracks": [ellipse], "beams": 8} | config))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    unbounded = ("minimum value is -infinity", "maximum value is infinity")
    serious = [str(each.message) for each in caught if not any(text in str(each.message) for text in unbounded)]
    assert serious == []


def test_the_passive_checker_is_silent(ellipse):
    """It watches every step of an environment that `make` made."""
    env = gym.make(NAME, tracks=[ellipse], beams=8, termination={"time_limit": 0.05})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.action_space.seed(0)
        for seed in range(3):
            env.reset(seed=seed)
            over = False
            while not over:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                over = terminated or truncated


def test_an_environment_can_be_made_from_its_own_spec(ellipse):
    env = gym.make(NAME, tracks=[ellipse], beams=4, lidar={"noise_std": 0.1})
    assert env.spec is not None
    again = gym.make(env.spec)
    a, b = env.reset(seed=3)[0], again.reset(seed=3)[0]
    np.testing.assert_array_equal(a["scan"], b["scan"])


def test_stepping_needs_a_reset_at_the_beginning_and_after_the_end(ellipse):
    env = make_race(tracks=[ellipse], beams=0, termination={"time_limit": 0.02})
    with pytest.raises(OutlapError, match="reset"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    env.step(np.zeros(2))
    _, _, terminated, truncated, info = env.step(np.zeros(2))
    assert (terminated, truncated, info["outcome"]) == (False, True, "timeout")
    with pytest.raises(OutlapError, match="reset"):
        env.step(np.zeros(2))
    env.reset()
    env.step(np.zeros(2))


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ([np.nan, 0.0], "finite"),
        ([0.0, -np.inf], "finite"),
        ([0.0], "shape"),
        (0.0, "shape"),
        ([[0.0, 0.0]], "shape"),
    ],
)
def test_wrong_actions_are_refused(ellipse, action, words):
    env = make_race(tracks=[ellipse], beams=0)
    env.reset(seed=0)
    with pytest.raises(OutlapError, match=words):
        env.step(np.array(action))


def test_lap_times_come_into_the_info_with_the_first_lap(circle):
    driver = CenterlineFollower(speed_action=-0.28)  # 4 m/s around the circle of 4 m radius
    start = {"anywhere": False, "speed": 4.0, "offset": 0.0}
    env = make_race(tracks=[circle], beams=0, control_interval=10, start=start, observation=driver.observation_terms)
    observation, _ = env.reset(seed=0)
    for _ in range(80):
        action = driver.act({name: value[None] for name, value in observation.items()})[0]
        observation, *_, info = env.step(action)
        for name in ("lap_time_s", "last_lap_time_s"):
            assert (name in info) == (info["laps"] > 0)
    assert info["laps"] == 1
    assert info["lap_time_s"] == info["last_lap_time_s"] == pytest.approx(2.0 * np.pi, rel=0.1)


def test_what_is_returned_is_not_a_live_buffer(ellipse):
    env = make_race(tracks=[ellipse], beams=6, observation=EVERYTHING)
    observation, info = env.reset(seed=0)
    kept = {name: value.copy() for name, value in observation.items()}
    vehicle = info["vehicle"].copy()
    for _ in range(5):
        env.step(np.array([0.3, 0.0]))
    env.reset()
    for name, value in kept.items():
        np.testing.assert_array_equal(observation[name], value)
    np.testing.assert_array_equal(info["vehicle"], vehicle)


def test_gymnasiums_statistics_agree_with_ours(ellipse):
    """Its wrappers find the end of an episode, single and vectorised, and sum the same return."""
    config = {"tracks": [ellipse], "beams": 0, "termination": {"time_limit": 0.1}, "start": {"speed": 2.0}}
    single = RecordEpisodeStatistics(gym.make(NAME, **config))
    single.reset(seed=0)
    over = False
    while not over:
        _, _, terminated, truncated, info = single.step(np.array([0.2, 0.1], np.float32))
        over = terminated or truncated
    assert info["episode"]["l"] == info["episode_steps"] == 10
    assert info["episode"]["r"] == pytest.approx(info["episode_return"])

    vector = RecordVectorStatistics(
        gym.make_vec(NAME, num_envs=3, vectorization_mode="vector_entry_point", **config)  # type: ignore[arg-type]
    )
    vector.reset(seed=0)
    for _ in range(10):
        *_, info = vector.step(np.tile(np.array([0.2, 0.1], np.float32), (3, 1)))
    np.testing.assert_allclose(info["episode"]["r"], info["final_info"]["episode_return"], rtol=1e-6)
    np.testing.assert_array_equal(info["episode"]["l"], 10)


def test_real_circuits_by_name(real_tracks, monkeypatch):
    """As in the README: tracks=["IMS"]. Pure pursuit is shown the racing line in its file, with its speeds."""
    monkeypatch.setenv("OUTLAP_TRACKS", str(real_tracks))
    env = gym.make_vec(
        NAME,
        num_envs=8,
        vectorization_mode="vector_entry_point",
        tracks=["IMS", "Spielberg"],
        num_cars=2,
        beams=108,
        control_interval=4,
    )
    _, info = env.reset(seed=0)
    assert set(info["track"]) == {"IMS", "Spielberg"}
    for _ in range(25):
        observation, _, _, _, info = env.step(np.tile(np.array([0.0, -0.5], np.float32), (8, 1)))
    assert env.observation_space.contains(observation)
    race = env.unwrapped.race  # type: ignore[attr-defined]
    track = race.simulator.tracks[1]
    first, rows = race.simulator.atlas.index[1, [FIRST_ROW, ROWS]]
    speeds = race.racing_line[first : first + rows, LINE_SPEED]
    slowest = np.argmin(track.raceline.speed)
    assert speeds.min() == pytest.approx(track.raceline.speed[slowest], abs=0.05)
    s, _ = track.centerline.to_frenet(track.raceline.x[slowest], track.raceline.y[slowest])
    assert np.argmin(speeds) * track.centerline.length / rows == pytest.approx(float(s), abs=0.5)
    assert speeds.max() == pytest.approx(track.raceline.speed.max(), abs=1e-3)
