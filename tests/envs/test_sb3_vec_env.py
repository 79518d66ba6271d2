"""Stable-Baselines3: its checks, its wrappers, and learning on SB3VecEnv."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from outlap.envs.episodes import EPISODE_FIELDS
from outlap.envs.keywords import make_race, make_race_vector, make_sb3
from outlap.errors import OutlapError
from outlap.training.callback import CurriculumCallback

SHORT = {"time_limit": 0.2}  # 20 steps


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("scaled", [False, True])
def test_sb3s_check_finds_nothing_in_the_single_environment(ellipse, scaled):
    env = make_race(tracks=[ellipse], beams=16, num_cars=2, scale_observations=scaled, lidar={"noise_std": 0.2})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


def test_its_shapes_and_types_are_what_sb3_expects(ellipse):
    env = make_sb3(num_envs=3, tracks=[ellipse], num_cars=1, beams=7, control_interval=1)
    assert isinstance(env, VecEnv)
    assert env.num_envs == 3
    observation = env.reset()
    assert isinstance(observation, dict)
    assert {name: value.shape for name, value in observation.items()} == {
        "scan": (3, 7),
        "pose": (3, 3),
        "vel": (3, 3),
        "heading": (3, 2),
    }
    observation, rewards, dones, infos = env.step(np.zeros((3, 2), np.float32))
    assert rewards.dtype == np.float32
    assert rewards.shape == dones.shape == (3,)
    assert dones.dtype == bool
    assert [info["track"] for info in infos] == ["ellipse"] * 3
    assert len({id(info) for info in infos}) == 3
    assert env.get_attr("num_envs", [0, 2]) == [3, 3]
    assert env.env_is_wrapped(VecMonitor) == [False] * 3
    env.set_attr("training_progress", 0.25)
    assert env.get_attr("training_progress") == [0.25] * 3
    env.close()


def test_it_is_the_vector_environment_with_the_same_seeds(ellipse, circle):
    """Observations, rewards, ends; and the outcome, reward terms and final observation of what ended."""
    config = {
        "tracks": [ellipse, circle],
        "beams": 9,
        "num_cars": 2,
        "vehicle": {"mu": (0.5, 1.1)},
        "lidar": {"noise_std": 0.1},
        "termination": {"time_limit": 1.0},
        "control_interval": 4,
        "start": {"speed": (0.0, 5.0)},
    }
    ours, sb3 = make_race_vector(4, **config), make_sb3(4, **config)
    expected, _ = ours.reset(seed=7)
    sb3.seed(7)
    observation = sb3.reset()
    rng = np.random.default_rng(0)
    ends = {"crash": 0, "timeout": 0}
    for _ in range(120):
        for name, value in expected.items():
            np.testing.assert_array_equal(observations(observation)[name], value)
        actions = rng.uniform(-1.0, [1.0, 0.2], (4, 2)).astype(np.float32)
        expected, reward, terminated, truncated, info = ours.step(actions)
        observation, sb3_reward, dones, infos = sb3.step(actions)
        np.testing.assert_array_equal(sb3_reward, reward.astype(np.float32))
        np.testing.assert_array_equal(dones, terminated | truncated)
        for world in range(4):
            its = infos[world]
            if not dones[world]:
                assert not {"episode", "terminal_observation", "TimeLimit.truncated"} & set(its)
                continue
            final = {name: value[world] for name, value in info["final_info"].items()}
            ends[final["outcome"]] += 1
            assert its["TimeLimit.truncated"] is bool(truncated[world])
            assert its["TimeLimit.truncated"] == (its["outcome"] != "crash")
            for name, value in info["final_obs"][world].items():
                np.testing.assert_array_equal(its["terminal_observation"][name], value)
            assert not np.array_equal(its["terminal_observation"]["pose"], observations(observation)["pose"][world])
            assert its["outcome"] == final["outcome"]
            assert its["track"] == final["track"]
            assert its["episode"]["r"] == final["episode_return"]
            assert its["episode"]["l"] == final["episode_steps"]
            assert its["episode"]["t"] == final["time_s"]
            for name in EPISODE_FIELDS:
                np.testing.assert_array_equal(its["episode"][name], final[name])
            for name in ("reward_progress", "reward_collision"):
                assert its[name] == final[name]
    assert min(ends.values()) > 2, ends


def test_seeds_hold_for_one_reset(ellipse):
    env = make_sb3(2, tracks=[ellipse], beams=0)
    env.seed(3)
    first, second = env.reset()["pose"], env.reset()["pose"]
    assert not np.array_equal(first, second)
    env.seed(3)
    np.testing.assert_array_equal(env.reset()["pose"], first)
    np.testing.assert_array_equal(env.reset()["pose"], second)


def test_what_it_returns_is_not_a_live_buffer(ellipse):
    env = make_sb3(3, tracks=[ellipse], beams=5, termination=SHORT)
    env.seed(0)
    env.reset()
    returned = []
    for _ in range(45):
        observation, rewards, dones, infos = env.step(np.tile(np.array([0.1, 0.0], np.float32), (3, 1)))
        arrays = [*observations(observation).values(), rewards, dones]
        for info in infos:
            arrays += info.get("terminal_observation", {}).values()
        returned.append((arrays, [array.copy() for array in arrays]))
    assert max(len(arrays) for arrays, _ in returned) > 6
    for arrays, copies in returned:
        for array, copy in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, copy)


def test_the_monitor_wrapper_agrees_with_our_own_episodes(ellipse):
    env = VecMonitor(make_sb3(3, tracks=[ellipse], beams=0, termination=SHORT), info_keywords=("outcome",))
    env.seed(0)
    env.reset()
    episodes = 0
    for _ in range(61):
        _, _, dones, infos = env.step(np.tile(np.array([0.0, 0.1], np.float32), (3, 1)))
        for world in np.flatnonzero(dones):
            episodes += 1
            monitored = infos[world]["episode"]
            assert monitored["l"] == infos[world]["episode_steps"] == 20
            assert monitored["r"] == pytest.approx(infos[world]["episode_return"], rel=1e-5)
            assert monitored["outcome"] == "timeout"
    assert episodes == 9


def test_sb3s_own_normalisation_runs_on_it(ellipse):
    env = VecNormalize(make_sb3(2, tracks=[ellipse], beams=4, termination=SHORT), norm_obs_keys=["vel", "scan"])
    env.reset()
    for _ in range(25):
        observation, _, _, _ = env.step(np.zeros((2, 2), np.float32))
    assert np.isfinite(observations(observation)["scan"]).all()


def observations(value: object) -> dict[str, np.ndarray]:
    """SB3 types an observation as an array, a tuple or a dict; ours is a dict."""
    assert isinstance(value, dict)
    return value


class Watch(BaseCallback):
    """Keeps what training saw at every step."""

    def __init__(self) -> None:
        super().__init__()
        self.ends: list[tuple[bool, str]] = []
        self.progress: set[float] = set()

    def _on_step(self) -> bool:
        self.progress.update(self.training_env.get_attr("training_progress"))
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done:
                self.ends.append((info["TimeLimit.truncated"], info["outcome"]))
        return True


def test_ppo_learns_on_it(ellipse):
    """A few updates: parameters change, episodes are logged, predictions are legal actions."""
    env = make_sb3(8, tracks=[ellipse], beams=12, scale_observations=True, termination={"time_limit": 0.3})
    model = PPO("MultiInputPolicy", env, n_steps=32, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = [parameter.clone() for parameter in model.policy.parameters()]
    watch = Watch()
    model.learn(600, callback=[CurriculumCallback(), watch])
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
    assert watch.ends
    assert all(truncated == (outcome != "crash") for truncated, outcome in watch.ends)
    assert model.ep_info_buffer is not None
    assert {"r", "l", "progress_m"} <= set(model.ep_info_buffer[0])
    assert sorted(watch.progress) == [0.0, 256 / 600, 512 / 600]
    assert env.env.training_progress == 1.0
    action, _ = model.predict(env.reset(), deterministic=True)
    assert env.action_space.contains(action[0])


def test_a_replay_buffer_gets_the_final_observation_and_bootstraps_timeouts_only(ellipse):
    """What TD3 stores as the next state of an ended episode is not the next episode's first one."""
    env = make_sb3(2, tracks=[ellipse], beams=3, termination=SHORT, start={"speed": 4.0})
    model = TD3(
        "MultiInputPolicy", env, learning_starts=10_000, buffer_size=400, seed=0, device="cpu",
        policy_kwargs={"net_arch": [8]},
    )  # fmt: skip
    model.learn(200)
    buffer = model.replay_buffer
    assert buffer is not None
    steps = buffer.size()
    dones = buffer.dones[:steps].astype(bool)
    pose, following = buffer.observations["pose"][:steps], buffer.next_observations["pose"][:steps]
    moved = np.hypot(*np.moveaxis(following - pose, -1, 0)[:2])
    assert dones.sum() >= 8
    assert moved.max() < 0.25, "a teleport was stored as a step"
    after_the_end = np.hypot(*np.moveaxis(pose[1:] - following[:-1], -1, 0)[:2])
    np.testing.assert_array_equal(after_the_end > 0.0, dones[:-1])
    timeouts = buffer.timeouts[:steps].astype(bool)
    assert (timeouts <= dones).all()
    assert timeouts.any()


@pytest.mark.parametrize("monitored", [False, True])
def test_evaluate_policy_counts_the_episodes(ellipse, monitored):
    env = make_sb3(4, tracks=[ellipse], beams=6, termination=SHORT)
    model = PPO("MultiInputPolicy", env, n_steps=16, batch_size=64, seed=0, device="cpu")
    wrapped = VecMonitor(env) if monitored else env
    returns, lengths = evaluate_policy(model, wrapped, n_eval_episodes=10, return_episode_rewards=True, warn=False)
    assert isinstance(lengths, list)
    assert lengths == [20] * 10
    assert np.isfinite(returns).all()


def test_wrong_keywords_are_named(ellipse):
    with pytest.raises(OutlapError, match="beam is not a known field; did you mean beams"):
        make_sb3(num_envs=2, tracks=[ellipse], beam=5)
    with pytest.raises(OutlapError, match="autoreset_mode"):
        make_sb3(num_envs=2, tracks=[ellipse], beams=0, autoreset_mode="Disabled")
