"""The reward of the step before, around an environment that plays a script."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv

from outlap.mql.collector import add_step, begin_episodes
from outlap.mql.context_vec_env import ContextVecEnv
from outlap.mql.networks import PREVIOUS_REWARD
from outlap.mql.replay import ReplayBuffer

BOX = gym.spaces.Box(-100.0, 100.0, (2,), np.float32)
REWARD = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
SPACES: dict[str, gym.spaces.Space] = {
    "box": BOX,
    "dict": gym.spaces.Dict({"vel": BOX}),
    "has it": gym.spaces.Dict({"vel": BOX, "previous_reward": REWARD}),
}
TERM = {"box": "observation", "dict": "vel", "has it": "vel"}  # where the observation proper is found

# Two worlds. World 1 ends its episode with the second step, both with the fourth.
REWARDS = [[1.0, -2.0], [3.0, 4.5], [5.0, 6.0], [-7.0, 8.0], [9.0, 10.0]]
DONES = [[False, False], [False, True], [False, False], [True, True], [False, False]]
SHOWN = [[1.0, -2.0], [3.0, 0.0], [5.0, 6.0], [0.0, 0.0], [9.0, 10.0]]


class Script(VecEnv):
    """Observation k of world w is (k, w), a terminal one (-k, w); 77 as previous reward where it has that term."""

    render_mode = None

    def __init__(self, kind: str, reward_type: type = np.float32, terminal: bool = True) -> None:
        super().__init__(2, SPACES[kind], gym.spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.kind, self.reward_type, self.terminal = kind, reward_type, terminal
        self.clock = 0
        self.actions: list[np.ndarray] = []
        self.closed = False
        self.given: list[Any] = []  # what it returned, as it was then

    def _form(self, values: np.ndarray) -> Any:
        if self.kind == "box":
            return values
        terms = {"vel": values}
        if self.kind == "has it":
            terms["previous_reward"] = np.full((*values.shape[:-1], 1), 77.0, np.float32)
        return terms

    def _observe(self) -> Any:
        return self._form(np.array([[self.clock, 0], [self.clock, 1]], np.float32))

    def reset(self) -> Any:
        self.clock = 0
        self.reset_infos = [{"track": "first 0"}, {"track": "first 1"}]
        return self._observe()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions.append(actions)

    def step_wait(self) -> Any:
        rewards = np.array(REWARDS[self.clock], self.reward_type)
        dones = np.array(DONES[self.clock])
        self.clock += 1
        infos: list[dict[str, Any]] = [{"clock": self.clock, "world": world} for world in range(2)]
        self.reset_infos = [dict(info) for info in self.reset_infos]
        for world in np.flatnonzero(dones).tolist():
            self.reset_infos[world] = {"track": f"begun at {self.clock}"}
            infos[world]["TimeLimit.truncated"] = world == 0
            if self.terminal:
                infos[world]["terminal_observation"] = self._form(np.array([-self.clock, world], np.float32))
        observation = self._observe()
        self.given.append((observation, copy.deepcopy(observation)))
        return observation, rewards, dones, infos

    def close(self) -> None:
        self.closed = True

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * 2

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        return [getattr(self, method_name)(*method_args, **method_kwargs)] * 2

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        return [False] * 2


ACTIONS = np.zeros((2, 1), np.float32)


def reset(env: VecEnv) -> dict[str, np.ndarray]:
    observation = env.reset()
    assert isinstance(observation, dict)
    return observation


def step(env: VecEnv) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
    observation, rewards, dones, infos = env.step(ACTIONS)
    assert isinstance(observation, dict)
    return observation, rewards, dones, infos


@pytest.mark.parametrize("kind", ["box", "dict"])
def test_the_space_is_a_dict_with_the_reward_in_it(kind: str) -> None:
    env = ContextVecEnv(Script(kind))
    assert env.observation_space == gym.spaces.Dict({TERM[kind]: BOX, "previous_reward": REWARD})
    assert env.num_envs == 2
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    assert PREVIOUS_REWARD == "previous_reward"


def test_the_space_that_it_wraps_stays_as_it_was() -> None:
    inner = Script("dict")
    ContextVecEnv(inner)
    assert inner.observation_space == gym.spaces.Dict({"vel": BOX})


@pytest.mark.parametrize("reward_type", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["box", "dict"])
def test_an_observation_shows_the_reward_of_the_step_before_it(kind: str, reward_type: type) -> None:
    env = ContextVecEnv(Script(kind, reward_type))
    observation = reset(env)
    assert env.observation_space.contains({name: value[0] for name, value in observation.items()})
    assert observation[PREVIOUS_REWARD].tolist() == [[0.0], [0.0]]
    assert observation[TERM[kind]].tolist() == [[0, 0], [0, 1]]
    for k, (shown, rewards, dones) in enumerate(zip(SHOWN, REWARDS, DONES, strict=True), start=1):
        observation, got, over, infos = step(env)
        assert observation.keys() == {TERM[kind], PREVIOUS_REWARD}
        assert observation[PREVIOUS_REWARD].dtype == np.float32
        assert observation[PREVIOUS_REWARD].tolist() == [[value] for value in shown]
        assert observation[TERM[kind]].tolist() == [[k, 0], [k, 1]]
        assert got.tolist() == rewards
        assert over.tolist() == dones
        assert [(info["clock"], info["world"]) for info in infos] == [(k, 0), (k, 1)]


@pytest.mark.parametrize("kind", ["box", "dict"])
def test_a_terminal_observation_holds_the_last_reward(kind: str) -> None:
    env = ContextVecEnv(Script(kind))
    reset(env)
    seen = {}
    for k in range(1, 6):
        *_, infos = step(env)
        for world, info in enumerate(infos):
            assert ("terminal_observation" in info) == DONES[k - 1][world]
            if "terminal_observation" in info:
                seen[k, world] = info["terminal_observation"]
                assert info["TimeLimit.truncated"] == (world == 0)
    assert seen.keys() == {(2, 1), (4, 0), (4, 1)}
    for (k, world), final in seen.items():
        assert final.keys() == {TERM[kind], PREVIOUS_REWARD}
        assert final[TERM[kind]].tolist() == [-k, world]
        assert final[PREVIOUS_REWARD].tolist() == [REWARDS[k - 1][world]]
        assert final[PREVIOUS_REWARD].dtype == np.float32
        assert isinstance(env.observation_space, gym.spaces.Dict)
        assert env.observation_space.contains(final)


def test_a_reward_after_a_reset_is_forgotten() -> None:
    env = ContextVecEnv(Script("box"))
    reset(env)
    observation, *_ = step(env)
    assert observation[PREVIOUS_REWARD].tolist() == [[1.0], [-2.0]]
    assert reset(env)[PREVIOUS_REWARD].tolist() == [[0.0], [0.0]]


def test_a_reward_that_is_there_already_is_left_alone() -> None:
    inner = Script("has it")
    env = ContextVecEnv(inner)
    assert env.observation_space == inner.observation_space
    assert reset(env)[PREVIOUS_REWARD].tolist() == [[77.0], [77.0]]
    for k in range(1, 6):
        observation, rewards, _, infos = step(env)
        assert observation.keys() == {"vel", PREVIOUS_REWARD}
        assert observation[PREVIOUS_REWARD].tolist() == [[77.0], [77.0]]
        assert rewards.tolist() == REWARDS[k - 1]
        for world in np.flatnonzero(DONES[k - 1]).tolist():
            final = infos[world]["terminal_observation"]
            assert final["vel"].tolist() == [-k, world]
            assert final[PREVIOUS_REWARD].tolist() == [77.0]


def test_what_the_inner_environment_returned_is_not_written_to() -> None:
    inner = Script("dict")
    env = ContextVecEnv(inner)
    reset(env)
    for _ in range(5):
        step(env)
    assert len(inner.given) == 5
    for returned, then in inner.given:
        assert returned.keys() == then.keys() == {"vel"}
        np.testing.assert_array_equal(returned["vel"], then["vel"])


def test_an_end_without_a_terminal_observation_gets_none() -> None:
    env = ContextVecEnv(Script("box", terminal=False))
    reset(env)
    for _ in range(5):
        *_, infos = step(env)
        assert all("terminal_observation" not in info for info in infos)


@pytest.mark.parametrize("kind", list(SPACES))
def test_reset_infos_are_passed_on(kind: str) -> None:
    env = ContextVecEnv(Script(kind))
    env.reset()
    assert env.reset_infos == [{"track": "first 0"}, {"track": "first 1"}]
    tracks = []
    for _ in range(5):
        env.step(ACTIONS)
        tracks.append([info["track"] for info in env.reset_infos])
    assert tracks == [
        ["first 0", "first 1"],
        ["first 0", "begun at 2"],
        ["first 0", "begun at 2"],
        ["begun at 4", "begun at 4"],
        ["begun at 4", "begun at 4"],
    ]


def test_actions_and_closing_reach_the_inner_environment() -> None:
    inner = Script("box")
    env = ContextVecEnv(inner)
    env.reset()
    env.step(np.array([[0.25], [-0.5]], np.float32))
    assert [action.tolist() for action in inner.actions] == [[[0.25], [-0.5]]]
    env.close()
    assert inner.closed


@pytest.mark.parametrize("kind", ["box", "dict"])
def test_in_a_replay_the_term_is_the_reward_of_the_row(kind: str) -> None:
    """Also in an episode's last row, which the replay takes from the terminal observation."""
    env = ContextVecEnv(Script(kind))
    assert isinstance(env.observation_space, gym.spaces.Dict)
    buffer = ReplayBuffer(100, env.observation_space, 1, 2)
    begin_episodes(buffer, env, reset(env))
    for _ in range(5):
        observation, rewards, dones, infos = step(env)
        add_step(buffer, env, observation, ACTIONS, rewards, dones, infos)
    assert buffer.added == 2 + 5 * 2 + 3
    # begin; step 1; step 2 and world 1's next episode; step 3; step 4 and two episodes; step 5.
    expected = [0, 0, 1, -2, 3, 4.5, 0, 5, 6, -7, 8, 0, 0, 9, 10]
    assert buffer.observation[PREVIOUS_REWARD][:15, 0].tolist() == expected
    assert buffer.reward[:15].tolist() == expected
    assert np.flatnonzero(buffer.terminated[:15]).tolist() == [5, 10]  # world 0's end is a time limit
    assert buffer.tasks == ["first 0", "first 1", "begun at 2", "begun at 4"]
