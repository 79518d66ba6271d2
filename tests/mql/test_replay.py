"""Replay against a stream worked out by hand, and against plain Python lists of episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from outlap.envs.keywords import make_sb3
from outlap.errors import OutlapError
from outlap.mql.batch import Batch, Windows
from outlap.mql.collector import add_step, begin_episodes, task_of
from outlap.mql.context_vec_env import ContextVecEnv
from outlap.mql.replay import ReplayBuffer, TaskName
from synthetic_tracks import ring

VEL = gym.spaces.Dict({"vel": gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)})
FIELDS = ("action", "reward", "curriculum", "terminated", "before", "after", "task")


def space(**sizes: int) -> gym.spaces.Dict:
    return gym.spaces.Dict({name: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for name, n in sizes.items()})


def vel(*values: float) -> dict[str, np.ndarray]:
    return {"vel": np.array(values, np.float32)[:, None]}


def begin(buffer: ReplayBuffer, worlds: Sequence[int], values: Sequence[float], tasks: Sequence[TaskName]) -> None:
    buffer.begin(np.array(worlds, int), vel(*values), tasks)


def add(
    buffer: ReplayBuffer,
    worlds: Sequence[int],
    values: Sequence[float],
    rewards: Sequence[float],
    terminated: Sequence[int] = (),
) -> None:
    """Rows whose action is a hundredth of their `vel`; `terminated` names worlds."""
    action = np.array(values)[:, None] / 100.0
    buffer.add(np.array(worlds), vel(*values), action, np.array(rewards), np.isin(worlds, terminated))


def in_numpy(read: Any) -> Any:
    """What was read, with an array for each tensor."""
    if isinstance(read, torch.Tensor):
        return read.numpy()
    if isinstance(read, Windows | Batch):
        return replace(read, **{each.name: in_numpy(getattr(read, each.name)) for each in fields(read)})
    return {name: in_numpy(value) for name, value in read.items()} if isinstance(read, dict) else read


def gather(buffer: ReplayBuffer, *args: Any, **kwargs: Any) -> Any:
    return in_numpy(buffer.gather(*args, **kwargs))


def windows_of(buffer: ReplayBuffer, *args: Any) -> Any:
    return in_numpy(buffer.windows(*args))


# By hand. Serials, with world 0's rows on the left:
#
#   begin   0: 10          1: 50
#   step 1  2: 11  (r 1)   3: 51  (r 1)
#   step 2  4: 12  (r 2)   5: 52  (r 10)
#   step 3  6: 13  (r 4)   7: 53  (r 100)     world 0 terminates; 8: 20 begins its next episode
#   step 4  9: 21  (r 8)  10: 54  (r 1000)
#   step 5 11: 22  (r 16) 12: 55  (r 10000)   world 1 is cut short; 13: 60 begins its next
#   step 6 14: 23  (r 32) 15: 61  (r 7)


def by_hand(capacity: int = 100) -> ReplayBuffer:
    buffer = ReplayBuffer(capacity, VEL, 1, 2)
    begin(buffer, [0, 1], [10, 50], ["left", "right"])
    add(buffer, [0, 1], [11, 51], [1, 1])
    add(buffer, [0, 1], [12, 52], [2, 10])
    add(buffer, [0, 1], [13, 53], [4, 100], terminated=[0])
    begin(buffer, [0], [20], ["right"])
    add(buffer, [0, 1], [21, 54], [8, 1000])
    add(buffer, [0, 1], [22, 55], [16, 10000])
    begin(buffer, [1], [60], ["left"])
    add(buffer, [0, 1], [23, 61], [32, 7])
    return buffer


DEPARTURES = (0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 13)  # all that have a row after them


def test_rows_are_numbered_as_they_come_and_know_their_episode() -> None:
    buffer = by_hand()
    assert (buffer.added, buffer.oldest, buffer.transitions()) == (16, 0, 12)
    order = [10, 50, 11, 51, 12, 52, 13, 53, 20, 21, 54, 22, 55, 60, 23, 61]
    assert buffer.observation["vel"][:16, 0].tolist() == order
    assert buffer.before[:16].tolist() == [-1, -1, 0, 1, 2, 3, 4, 5, -1, 8, 7, 9, 10, -1, 11, 13]
    assert buffer.after[:16].tolist() == [2, 3, 4, 5, 6, 7, -1, 10, 9, 11, 12, 14, -1, 15, -1, -1]
    assert np.flatnonzero(buffer.terminated).tolist() == [6]
    assert buffer.latest.tolist() == [14, 15]
    assert buffer.tasks == ["left", "right"]
    assert buffer.task[:16].tolist() == [0, 1, 0, 1, 0, 1, 0, 1, 1, 1, 1, 1, 1, 0, 1, 0]
    assert (buffer.transitions("left"), buffer.transitions("right")) == (4, 8)


def test_what_is_drawn_are_the_rows_that_have_a_row_after_them() -> None:
    drawn = by_hand().sample(2000, np.random.default_rng(0))
    assert drawn.shape == (2000,)
    assert tuple(np.unique(drawn)) == DEPARTURES


def test_windows_are_padded_before_an_episode_begins() -> None:
    windows = windows_of(by_hand(), np.array([0, 2, 6, 8, 9, 14, 12]), 3, ["vel"])
    assert windows.observation["vel"][:, :, 0].T.tolist() == [
        [0, 0, 10],
        [0, 10, 11],
        [11, 12, 13],
        [0, 0, 20],
        [0, 20, 21],
        [21, 22, 23],
        [53, 54, 55],
    ]
    assert windows.valid.T.tolist() == [
        [False, False, True],
        [False, True, True],
        [True, True, True],
        [False, False, True],
        [False, True, True],
        [True, True, True],
        [True, True, True],
    ]
    np.testing.assert_allclose(
        windows.action[:, :, 0].T,
        [
            [0, 0, 0],
            [0, 0, 0.11],
            [0.11, 0.12, 0.13],
            [0, 0, 0],
            [0, 0, 0.21],
            [0.21, 0.22, 0.23],
            [0.53, 0.54, 0.55],
        ],
        rtol=1e-6,
    )


def test_the_window_of_a_world_without_an_episode_is_empty() -> None:
    buffer = ReplayBuffer(100, VEL, 1, 2)
    begin(buffer, [1], [5], ["task"])
    windows = windows_of(buffer, buffer.latest, 2, ["vel"])
    assert windows.valid.T.tolist() == [[False, False], [False, True]]
    assert windows.observation["vel"][:, :, 0].T.tolist() == [[0, 0], [0, 5]]


def test_windows_hold_the_terms_that_are_asked_for() -> None:
    buffer = ReplayBuffer(100, space(vel=1, heading=2, pose=3), 1, 1)
    first = {"vel": np.ones((1, 1)), "heading": np.ones((1, 2)), "pose": np.ones((1, 3))}
    buffer.begin(np.array([0]), first, ["task"])
    windows = windows_of(buffer, np.array([0]), 4, ["pose", "vel"])
    assert {name: values.shape for name, values in windows.observation.items()} == {"pose": (4, 1, 3), "vel": (4, 1, 1)}


def test_the_first_rows_of_windows() -> None:
    first = windows_of(by_hand(), np.array([2, 14]), 3, ["vel"]).first(2)
    assert first.observation["vel"][:, :, 0].T.tolist() == [[0, 10], [21, 22]]
    assert first.valid.T.tolist() == [[False, True], [True, True]]
    np.testing.assert_allclose(first.action[:, :, 0].T, [[0, 0], [0.21, 0.22]], rtol=1e-6)


def test_transitions_of_one_step() -> None:
    # From 10 and from 50; into the terminated 13; into 55, which is cut short; into the newest row 23.
    batch = gather(by_hand(), np.array([0, 1, 4, 10, 11]), history=2, n_steps=1, gamma=0.5, terms=["vel"])
    assert batch.serial.tolist() == [0, 1, 4, 10, 11]
    assert batch.task.tolist() == [0, 1, 0, 1, 1]
    assert batch.reward.tolist() == [1, 1, 4, 10000, 32]
    assert batch.discount.tolist() == [0.5, 0.5, 0.0, 0.5, 0.5]
    assert batch.steps.tolist() == [1, 1, 1, 1, 1]
    assert batch.observation["vel"][:, 0].tolist() == [10, 50, 12, 54, 22]
    assert batch.next_observation["vel"][:, 0].tolist() == [11, 51, 13, 55, 23]
    np.testing.assert_allclose(batch.action[:, 0], [0.11, 0.51, 0.13, 0.55, 0.23], rtol=1e-6)
    assert batch.windows.observation["vel"][:, :, 0].T.tolist() == [
        [0, 10, 11],
        [0, 50, 51],
        [11, 12, 13],
        [53, 54, 55],
        [21, 22, 23],
    ]


BY_HAND_IN_THREE_STEPS = {
    # serial: reward, discount, steps, arrival; γ = 1/2
    0: (1 + 2 / 2 + 4 / 4, 0.0, 3, 13),  # terminates with the last of the three steps
    2: (2 + 4 / 2, 0.0, 2, 13),
    4: (4, 0.0, 1, 13),
    1: (1 + 10 / 2 + 100 / 4, 1 / 8, 3, 53),
    7: (1000 + 10000 / 2, 1 / 4, 2, 55),  # cut short
    10: (10000, 1 / 2, 1, 55),
    8: (8 + 16 / 2 + 32 / 4, 1 / 8, 3, 23),
    9: (16 + 32 / 2, 1 / 4, 2, 23),  # the newest row there is
    11: (32, 1 / 2, 1, 23),
    13: (7, 1 / 2, 1, 61),
}


def test_transitions_of_three_steps_are_shorter_where_the_episode_ends() -> None:
    serial = np.array(list(BY_HAND_IN_THREE_STEPS))
    batch = gather(by_hand(), serial, history=2, n_steps=3, gamma=0.5, terms=["vel"])
    reward, discount, steps, arrival = zip(*BY_HAND_IN_THREE_STEPS.values(), strict=True)
    assert batch.reward.tolist() == list(reward)
    assert batch.discount.tolist() == list(discount)
    assert batch.steps.tolist() == list(steps)
    assert batch.next_observation["vel"][:, 0].tolist() == list(arrival)
    assert batch.observation["vel"][:, 0].tolist() == [10, 11, 12, 50, 53, 54, 20, 21, 22, 60]


def test_windows_of_three_steps_repeat_the_last_row_where_the_episode_ends() -> None:
    batch = gather(by_hand(), np.array([0, 2, 4, 8, 9, 13]), history=3, n_steps=3, gamma=0.5, terms=["vel"])
    assert batch.windows.observation["vel"][:, :, 0].T.tolist() == [
        [0, 0, 10, 11, 12, 13],
        [0, 10, 11, 12, 13, 13],
        [10, 11, 12, 13, 13, 13],
        [0, 0, 20, 21, 22, 23],
        [0, 20, 21, 22, 23, 23],
        [0, 0, 60, 61, 61, 61],
    ]
    assert batch.windows.valid.sum(0).tolist() == [4, 5, 6, 4, 5, 4]
    assert batch.windows.valid[2:].all()


@pytest.mark.parametrize("n_steps", [1, 2, 3, 5])
def test_a_window_holds_the_departure_and_the_arrival_where_it_says(n_steps: int) -> None:
    buffer, history = by_hand(), 3
    batch = gather(buffer, np.array(DEPARTURES), history=history, n_steps=n_steps, gamma=0.5, terms=["vel"])
    held, each = batch.windows.observation["vel"], np.arange(len(DEPARTURES))
    assert held.shape == (history + n_steps, len(DEPARTURES), 1)
    expected = [10, 50, 11, 51, 12, 52, 53, 20, 21, 54, 22, 60]
    assert held[history - 1, :, 0].tolist() == expected == batch.observation["vel"][:, 0].tolist()
    np.testing.assert_array_equal(held[history - 1 + batch.steps, each], batch.next_observation["vel"])
    # The window that ends at the arrival is that of the arrival itself.
    arrivals = [serial_of(buffer, value) for value in batch.next_observation["vel"][:, 0]]
    ends = windows_of(buffer, np.array(arrivals), history, ["vel"])
    cut = batch.steps + np.arange(history)[:, None]
    np.testing.assert_array_equal(held[cut, each], ends.observation["vel"])
    np.testing.assert_array_equal(batch.windows.valid[cut, each], ends.valid)


def serial_of(buffer: ReplayBuffer, value: float) -> int:
    (serial,) = np.flatnonzero(buffer.observation["vel"][:, 0] == value)
    return int(serial)


def test_both_observations_are_the_same_whether_or_not_a_window_holds_the_term() -> None:
    buffer = by_hand()
    within = gather(buffer, np.array(DEPARTURES), history=2, n_steps=2, terms=["vel"])
    without = gather(buffer, np.array(DEPARTURES), history=2, n_steps=2)
    assert without.windows.observation == {}
    for one, other in ((within, without), (without, within)):
        np.testing.assert_array_equal(one.observation["vel"], other.observation["vel"])
        np.testing.assert_array_equal(one.next_observation["vel"], other.next_observation["vel"])


def test_a_window_ends_where_older_rows_are_gone() -> None:
    buffer = by_hand(capacity=8)  # keeps serials 8 … 15
    assert (buffer.oldest, buffer.transitions()) == (8, 5)
    assert np.unique(buffer.sample(500, np.random.default_rng(0))).tolist() == [8, 9, 10, 11, 13]
    windows = windows_of(buffer, np.array([10, 12]), 3, ["vel"])  # 53 was serial 7
    assert windows.observation["vel"][:, :, 0].T.tolist() == [[0, 0, 54], [0, 54, 55]]
    assert windows.valid.T.tolist() == [[False, False, True], [False, True, True]]


# Against plain lists.


@dataclass
class Row:
    serial: int
    episode: int
    value: float
    action: np.ndarray
    reward: float
    terminated: bool
    task: TaskName


class Lists:
    """Every row that there ever was, in lists of episodes."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.episodes: list[list[Row]] = []

    def append(self, episode: int, value: float, action: np.ndarray, reward: float, end: bool, task: TaskName) -> None:
        row = Row(len(self.rows), episode, value, action, reward, end, task)
        self.rows.append(row)
        self.episodes[episode].append(row)

    def departures(self, oldest: int) -> list[Row]:
        return [row for episode in self.episodes for row in episode[:-1] if row.serial >= oldest]

    def window(self, row: Row, length: int, oldest: int) -> list[Row]:
        episode = self.episodes[row.episode]
        seen = [earlier for earlier in episode[: episode.index(row) + 1] if earlier.serial >= oldest]
        return seen[-length:]

    def onwards(self, row: Row, n_steps: int) -> list[Row]:
        episode = self.episodes[row.episode]
        here = episode.index(row)
        return episode[here + 1 : here + 1 + n_steps]


class Stream:
    """Random episodes in many worlds, into a buffer and into lists; each world takes part in a share of the steps."""

    def __init__(self, buffer: ReplayBuffer, tasks: int, end: float, seed: int, share: float = 1.0) -> None:
        self.share = share
        self.buffer, self.lists, self.tasks, self.end = buffer, Lists(), tasks, end
        self.rng = np.random.default_rng(seed)
        self.episode_of = [-1] * buffer.num_worlds
        self.task_of: list[TaskName] = [None] * buffer.num_worlds
        self.begin(list(range(buffer.num_worlds)))

    def observe(self, n: int) -> dict[str, np.ndarray]:
        """Values that no other row has: `scan` holds the serial modulo 2000, which float16 holds exactly."""
        serial = len(self.lists.rows) + np.arange(n)
        return {"vel": serial[:, None] + 0.5, "scan": np.repeat(serial[:, None] % 2000, 3, axis=1)}

    def begin(self, worlds: list[int]) -> None:
        names = [f"task {self.rng.integers(self.tasks)}" for _ in worlds]
        seen = self.observe(len(worlds))
        self.buffer.begin(np.array(worlds), seen, names)
        for i, (world, name) in enumerate(zip(worlds, names, strict=True)):
            self.task_of[world] = name
            self.episode_of[world] = len(self.lists.episodes)
            self.lists.episodes.append([])
            self.lists.append(self.episode_of[world], seen["vel"][i, 0], np.zeros(2), 0.0, False, name)

    def step(self) -> None:
        worlds = self.rng.permutation(self.buffer.num_worlds)
        worlds = worlds[self.rng.random(len(worlds)) < self.share]
        n = len(worlds)
        seen = self.observe(n)
        action = self.rng.uniform(-1.0, 1.0, (n, 2)).astype(np.float32)
        reward = self.rng.normal(size=n).astype(np.float32)
        over = self.rng.random(n) < self.end
        terminated = over & (self.rng.random(n) < 0.5)
        self.buffer.add(worlds, seen, action, reward, terminated)
        for i, world in enumerate(worlds.tolist()):
            episode, task = self.episode_of[world], self.task_of[world]
            self.lists.append(episode, seen["vel"][i, 0], action[i], float(reward[i]), bool(terminated[i]), task)
        if over.any():
            self.begin(sorted(worlds[over].tolist()))


def check_windows(windows: Windows, expected: list[list[Row]], length: int) -> None:
    for i, rows in enumerate(expected):
        padding = length - len(rows)
        assert windows.valid[:length, i].tolist() == [False] * padding + [True] * len(rows)
        values = [0.0] * padding + [row.value for row in rows]
        assert windows.observation["vel"][:length, i, 0].tolist() == values
        scan = [[0.0] * 3] * padding + [[row.serial % 2000] * 3 for row in rows]
        assert windows.observation["scan"][:length, i].tolist() == scan
        np.testing.assert_array_equal(windows.action[:padding, i], 0.0)
        np.testing.assert_array_equal(windows.action[padding:length, i], [row.action for row in rows])


def check_batch(batch: Batch, lists: Lists, buffer: ReplayBuffer, history: int, n_steps: int, gamma: float) -> None:
    check_windows(
        batch.windows, [lists.window(lists.rows[s], history, buffer.oldest) for s in batch.serial.tolist()], history
    )
    for i, serial in enumerate(batch.serial.tolist()):
        row = lists.rows[serial]
        path = lists.onwards(row, n_steps)
        assert {step.episode for step in path} == {row.episode}
        assert batch.steps[i] == len(path)
        assert buffer.tasks[batch.task[i]] == row.task
        assert batch.reward[i] == pytest.approx(sum(gamma**k * step.reward for k, step in enumerate(path)), abs=1e-5)
        assert batch.discount[i] == pytest.approx(0.0 if path[-1].terminated else gamma ** len(path))
        np.testing.assert_array_equal(batch.action[i], path[0].action)
        repeated = path + [path[-1]] * (n_steps - len(path))
        assert batch.windows.observation["vel"][history:, i, 0].tolist() == [step.value for step in repeated]
        assert batch.windows.valid[history:, i].all()
        assert (batch.observation["vel"][i, 0], batch.next_observation["vel"][i, 0]) == (row.value, path[-1].value)
        assert batch.observation["scan"][i].tolist() == [serial % 2000] * 3
        assert batch.next_observation["scan"][i].tolist() == [path[-1].serial % 2000] * 3


@pytest.mark.parametrize(
    ("worlds", "capacity", "tasks", "end", "steps"),
    [
        (1, 3, 1, 0.3, 40),  # the smallest ring
        (1, 20, 2, 0.1, 200),
        (4, 12, 3, 0.5, 60),
        (5, 37, 3, 0.1, 150),
        (7, 200, 4, 0.02, 200),  # long episodes, whose beginnings are dropped
        (3, 10_000, 3, 0.1, 60),  # never full
    ],
)
@pytest.mark.parametrize(("history", "n_steps", "share"), [(1, 1, 1.0), (4, 1, 1.0), (6, 3, 1.0), (5, 2, 0.4)])
def test_random_streams_are_read_as_lists_of_episodes_are(
    worlds: int, capacity: int, tasks: int, end: float, steps: int, history: int, n_steps: int, share: float
) -> None:
    buffer = ReplayBuffer(capacity, space(vel=1, scan=3), 2, worlds)
    stream, rng = Stream(buffer, tasks, end, capacity, share), np.random.default_rng(1)
    for step in range(1, steps + 1):
        stream.step()
        lists = stream.lists
        oldest = max(0, len(lists.rows) - capacity)
        departures = lists.departures(oldest)
        assert (buffer.added, buffer.oldest) == (len(lists.rows), oldest)
        assert buffer.transitions() == len(departures)
        for task in buffer.tasks:
            assert buffer.transitions(task) == sum(row.task == task for row in departures)
        if step % (steps // 10) == 0 and departures:
            for by_task in (False, True):
                serial = buffer.sample(20, rng, by_task=by_task)
                assert set(serial.tolist()) <= {row.serial for row in departures}
                batch = gather(buffer, serial, history=history, n_steps=n_steps, gamma=0.9, terms=["scan", "vel"])
                check_batch(batch, lists, buffer, history, n_steps, 0.9)
            ends = [lists.episodes[episode][-1] for episode in stream.episode_of]
            assert buffer.latest.tolist() == [row.serial for row in ends]
            kept = [row for row in ends if row.serial >= oldest]
            newest = windows_of(buffer, np.array([row.serial for row in kept]), history, ["scan", "vel"])
            check_windows(newest, [lists.window(row, history, oldest) for row in kept], history)


@pytest.mark.parametrize("capacity", [30, 10_000])
def test_every_transition_that_is_kept_can_be_drawn(capacity: int) -> None:
    buffer = ReplayBuffer(capacity, space(vel=1, scan=3), 2, 4)
    stream = Stream(buffer, tasks=3, end=0.2, seed=5)
    for _ in range(50):
        stream.step()
    expected = {row.serial for row in stream.lists.departures(buffer.oldest)}
    for by_task in (False, True):
        drawn = buffer.sample(20_000, np.random.default_rng(2), by_task=by_task)
        assert set(drawn.tolist()) == expected


def test_a_world_that_adds_less_often_than_another_leaves_the_drawing_sound() -> None:
    buffer = ReplayBuffer(8, VEL, 1, 2)
    begin(buffer, [0, 1], [0, 1], ["task", "task"])
    for world in [0] * 6 + [1, 0]:
        add(buffer, [world], [9], [0])
    assert buffer.oldest == 2
    assert buffer.sample(500, np.random.default_rng(0)).min() >= 2


def test_a_world_keeps_its_task_when_its_newest_row_is_gone() -> None:
    buffer = ReplayBuffer(8, VEL, 1, 2)
    begin(buffer, [0, 1], [0, 1], ["a", "b"])
    for world in [0] * 8 + [1]:
        add(buffer, [world], [9], [0])
    assert buffer.tasks[buffer.task[buffer.latest[1] % 8]] == "b"


def test_a_row_whose_row_before_is_gone_is_linked_to_no_other() -> None:
    buffer = ReplayBuffer(8, VEL, 1, 2)
    begin(buffer, [0, 1], [0, 1], ["a", "a"])
    for value in range(2, 10):
        add(buffer, [0], [value], [1])
    add(buffer, [1], [99], [1])  # serial 10; that of its row before was 1, where 9 is now
    batch = gather(buffer, np.array([8]), history=1, n_steps=2, gamma=0.5, terms=["vel"])
    assert batch.windows.observation["vel"][:, 0, 0].tolist() == [8, 9, 9]
    assert (batch.steps[0], batch.reward[0]) == (1, 1)
    windows = windows_of(buffer, np.array([10]), 2, ["vel"])
    assert windows.observation["vel"][:, 0, 0].tolist() == [0, 99]
    assert windows.valid[:, 0].tolist() == [False, True]


# Which tasks are drawn.


def of_unequal_tasks(counts: Sequence[int], task_capacity: int | None = None) -> ReplayBuffer:
    """One world, an episode of `counts[i]` transitions of task i."""
    buffer = ReplayBuffer(10_000, VEL, 1, 1, task_capacity=task_capacity)
    for task, count in enumerate(counts):
        begin(buffer, [0], [0], [task])
        for i in range(count):
            add(buffer, [0], [i], [0])
    return buffer


def chi_square(drawn: np.ndarray, expected: np.ndarray) -> float:
    return float((np.square(drawn - expected) / expected).sum())


def test_by_task_every_task_is_drawn_as_often() -> None:
    buffer = of_unequal_tasks([10, 100, 900])
    serial = buffer.sample(30_000, np.random.default_rng(0), by_task=True)
    drawn = np.bincount(buffer.task[serial], minlength=3)
    assert drawn.sum() == 30_000
    assert chi_square(drawn, np.full(3, 10_000.0)) < 18.4  # 2 degrees of freedom: 1 in 10 000
    # Within a task, every transition: the first is that of rows 0 … 9.
    assert chi_square(np.bincount(serial[serial < 10], minlength=10), np.full(10, drawn[0] / 10)) < 33.7


def test_otherwise_every_transition_is_drawn_as_often() -> None:
    buffer = of_unequal_tasks([10, 100, 900])
    serial = buffer.sample(101_000, np.random.default_rng(0))
    drawn = np.bincount(buffer.task[serial], minlength=3)
    assert chi_square(drawn, np.array([1000.0, 10_000.0, 90_000.0])) < 18.4
    each = np.bincount(serial, minlength=buffer.added)
    assert chi_square(each[each > 0], np.full(1010, 100.0)) < 1184.0  # 1009 degrees of freedom: 1 in 10 000
    assert (each > 0).sum() == 1010


def test_a_task_of_which_nothing_is_left_is_not_drawn() -> None:
    buffer = ReplayBuffer(50, VEL, 1, 1)
    for task in ("gone", "kept"):
        begin(buffer, [0], [0], [task])
        for i in range(100):
            add(buffer, [0], [i], [0])
    assert (buffer.transitions("gone"), buffer.transitions("kept")) == (0, 49)
    assert set(buffer.task[buffer.sample(100, np.random.default_rng(0), by_task=True) % 50]) == {1}


def test_the_task_capacity_limits_what_is_drawn_to_the_newest() -> None:
    buffer = of_unequal_tasks([300, 70, 300], task_capacity=100)
    assert [buffer.transitions(task) for task in range(3)] == [100, 70, 100]
    assert buffer.transitions() == 270
    # Rows of the tasks: 0 … 300, 301 … 371, 372 … 672; the last of each has no row after it.
    newest = {*range(200, 300), *range(301, 371), *range(572, 672)}
    for by_task in (False, True):
        assert set(buffer.sample(10_000, np.random.default_rng(0), by_task=by_task).tolist()) == newest


def test_the_task_capacity_holds_when_rows_come_many_at_a_time() -> None:
    buffer = ReplayBuffer(10_000, VEL, 1, 150, task_capacity=100)
    worlds = range(150)
    begin(buffer, worlds, worlds, ["task"] * 150)
    for _ in range(2):
        add(buffer, worlds, worlds, [0] * 150)
    assert buffer.transitions() == 100
    assert set(buffer.sample(5000, np.random.default_rng(0)).tolist()) == set(range(200, 300))


def test_a_small_task_capacity_limits_too() -> None:
    buffer = of_unequal_tasks([200], task_capacity=10)
    assert buffer.transitions() == 10
    assert set(buffer.sample(1000, np.random.default_rng(0)).tolist()) == set(range(190, 200))


def test_the_same_generator_draws_the_same() -> None:
    draws = [by_hand().sample(50, np.random.default_rng(seed)) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])


# Saving.


@pytest.mark.parametrize("share", [1.0, 0.4])
@pytest.mark.parametrize("capacity", [40, 10_000])
def test_a_saved_buffer_goes_on_as_if_nothing_had_been(capacity: int, share: float, tmp_path: Path) -> None:
    """Saved before it is full, or after it was full many times."""
    one, other = (ReplayBuffer(capacity, space(vel=1, scan=3), 2, 4, task_capacity=70) for _ in range(2))
    streams = [Stream(buffer, 3, 0.1, 8, share) for buffer in (one, other)]
    for _ in range(60):
        streams[0].step()
        streams[1].step()
    loaded = ReplayBuffer.load(other.save(tmp_path / "replay.npz"))
    streams[1].buffer = loaded
    assert (loaded.capacity, loaded.task_capacity, loaded.num_worlds) == (capacity, 70, 4)
    for _ in range(60):
        assert (loaded.added, loaded.tasks, loaded.oldest) == (one.added, one.tasks, one.oldest)
        for task in (None, *one.tasks):
            assert loaded.transitions(task) == one.transitions(task)
        serial, again = (buffer.sample(30, np.random.default_rng(0), by_task=True) for buffer in (one, loaded))
        np.testing.assert_array_equal(serial, again)
        same_batch(*(gather(buffer, serial, history=5, n_steps=2, terms=["scan"]) for buffer in (one, loaded)))
        streams[0].step()
        streams[1].step()
    assert loaded.observation.keys() == one.observation.keys()
    columns = [(loaded.observation[name], one.observation[name]) for name in one.observation]
    for ours, theirs in columns + [(getattr(loaded, name), getattr(one, name)) for name in FIELDS]:
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
        used = min(one.added, capacity)
        np.testing.assert_array_equal(ours[:used], theirs[:used])
    batch = gather(
        loaded, loaded.sample(50, np.random.default_rng(1)), history=4, n_steps=3, gamma=0.9, terms=["scan", "vel"]
    )
    check_batch(batch, streams[1].lists, loaded, 4, 3, 0.9)


def same_batch(one: Batch, other: Batch) -> None:
    for name in ("serial", "task", "action", "reward", "discount", "steps"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("action", "valid"):
        np.testing.assert_array_equal(getattr(one.windows, name), getattr(other.windows, name))
    for ours, theirs in (
        (one.observation, other.observation),
        (one.next_observation, other.next_observation),
        (one.windows.observation, other.windows.observation),
    ):
        assert ours.keys() == theirs.keys()
        for name in ours:
            assert ours[name].dtype == theirs[name].dtype
            np.testing.assert_array_equal(ours[name], theirs[name])


def test_saving_changes_nothing(tmp_path: Path) -> None:
    buffer = by_hand()
    loaded = ReplayBuffer.load(buffer.save(tmp_path / "replay.npz"))
    add(loaded, [0, 1], [24, 62], [0, 0])
    assert (buffer.added, loaded.added) == (16, 18)
    assert (buffer.transitions(), loaded.transitions()) == (12, 14)
    assert (buffer.after[14], loaded.after[14]) == (-1, 16)


@pytest.mark.parametrize("rows", [0, 1])
def test_a_buffer_without_transitions_can_be_saved(rows: int, tmp_path: Path) -> None:
    buffer = ReplayBuffer(200, VEL, 1, 1)
    begin(buffer, [0] * rows, [10] * rows, ["task"] * rows)
    loaded = ReplayBuffer.load(buffer.save(tmp_path / "replay.npz"))
    assert (loaded.added, loaded.transitions(), loaded.tasks) == (rows, 0, ["task"] * rows)
    begin(loaded, [0], [10], ["task"])
    for i in range(100):  # more than there is place for at first
        add(loaded, [0], [i], [0])
    assert set(loaded.sample(5000, np.random.default_rng(0)).tolist()) == set(range(rows, rows + 100))


def test_tasks_are_loaded_as_what_they_were(tmp_path: Path) -> None:
    names: list[TaskName] = ["7", 7, None]
    buffer = ReplayBuffer(100, VEL, 1, 3)
    begin(buffer, range(3), range(3), names)
    loaded = ReplayBuffer.load(buffer.save(tmp_path / "replay.npz"))
    assert loaded.tasks == names
    add(loaded, range(3), range(3), [0, 0, 0])
    add(loaded, [1], [5], [0])
    assert (loaded.transitions("7"), loaded.transitions(7), loaded.transitions()) == (1, 2, 4)
    begin(loaded, range(3), range(3), names)
    assert loaded.tasks == names


def test_a_task_is_what_a_file_can_tell() -> None:
    assert [task_of({"task": task}) for task in (np.int64(7), np.str_("oval"))] == [7, "oval"]
    assert type(task_of({"task": np.int64(7)})) is int
    assert task_of({"track": "oval"}) == "oval"
    assert task_of({}) is None
    with pytest.raises(OutlapError, match=r"a world's task is \(1, 2\); must be a string, a whole number or None"):
        task_of({"task": (1, 2)})


RACE = {"scan": 540, "vel": 3, "heading": 2, "pose": 3}


def test_a_nearly_empty_buffer_is_saved_small_however_much_it_may_hold(tmp_path: Path) -> None:
    buffer = ReplayBuffer(1_000_000, space(**RACE), 2, 1)
    seen = {name: np.ones((1, size)) for name, size in RACE.items()}
    buffer.begin(np.array([0]), seen, ["task"])
    for _ in range(9):
        buffer.add(np.array([0]), seen, np.ones((1, 2)), np.ones(1), np.zeros(1, bool))
    path = buffer.save(tmp_path / "replay.npz")
    assert path.stat().st_size < 20_000  # ten rows of 1.2 kB, and the rest
    loaded = ReplayBuffer.load(path)
    assert loaded.observation["scan"].shape == (1_000_000, 540)
    assert loaded.transitions() == 9


def test_saving_takes_the_name_that_it_is_given_and_makes_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "new" / "replay.partial"
    assert by_hand().save(str(path)) == path
    by_hand(capacity=8).save(path)  # over the one before
    assert ReplayBuffer.load(str(path)).capacity == 8
    assert [file.name for file in path.parent.iterdir()] == ["replay.partial"]


def test_saving_that_fails_leaves_the_file_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = by_hand().save(tmp_path / "replay.npz")
    before = path.read_bytes()

    def full(file: Any, **arrays: np.ndarray) -> None:
        file.write(b"half of it")
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space left"):
        by_hand(capacity=8).save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "broken",
    [
        "missing", "empty", "not an archive", "of a later version", "cut short", "lacks a column", "other numbers",
        "other axes", "pickled",
    ],
)  # fmt: skip
def test_what_is_no_replay_is_an_error_that_names_the_file(broken: str, tmp_path: Path) -> None:
    path = by_hand().save(tmp_path / "replay.npz")
    whole = path.read_bytes()
    with np.load(path) as file:
        arrays = dict(file)
    if broken == "missing":
        path.unlink()
    elif broken == "empty":
        path.write_bytes(b"")
    elif broken == "not an archive":
        path.write_text("a few words")
    elif broken == "of a later version":
        needed = whole.index(b"PK\x01\x02") + 6  # of the first member, in the archive's directory
        path.write_bytes(whole[:needed] + b"\x5d" + whole[needed + 1 :])
    elif broken == "cut short":
        path.write_bytes(whole[: len(whole) // 2])
    elif broken == "lacks a column":
        del arrays["after"]
        np.savez(path, **arrays)
    elif broken == "other numbers":
        np.savez(path, **{**arrays, "observation/vel": arrays["observation/vel"].astype(np.int64)})
    elif broken == "other axes":
        np.savez(path, **{**arrays, "reward": arrays["reward"][:, None]})
    else:
        np.savez(path, **{**arrays, "task": np.array([object()])})  # type: ignore[arg-type]
    with pytest.raises(OutlapError, match=r"replay\.npz: cannot be read as a replay"):
        ReplayBuffer.load(path)


# What it is stored as.


def test_a_million_rows_of_a_race_fit_into_three_gigabytes() -> None:
    buffer = ReplayBuffer(1_000_000, space(**RACE), 2, 16)
    columns = [value for value in vars(buffer).values() if isinstance(value, np.ndarray)]
    assert sum(column.nbytes for column in [*columns, *buffer.observation.values()]) < 3e9
    assert {name: column.shape for name, column in buffer.observation.items()} == {
        name: (1_000_000, size) for name, size in RACE.items()
    }


def test_scans_are_stored_in_half_precision_to_8_mm_and_the_rest_in_single() -> None:
    rng = np.random.default_rng(0)
    scan, velocity = rng.uniform(0.0, 30.0, (1, 540)).astype(np.float32), rng.normal(size=(1, 3)).astype(np.float32)
    buffer = ReplayBuffer(10, space(scan=540, vel=3), 2, 1)
    buffer.begin(np.array([0]), {"scan": scan, "vel": velocity}, ["task"])
    buffer.add(np.array([0]), {"scan": scan / 2, "vel": velocity / 3}, np.ones((1, 2)), np.ones(1), np.zeros(1, bool))
    assert buffer.observation["scan"].dtype == np.float16
    assert buffer.observation["vel"].dtype == np.float32
    windows = windows_of(buffer, np.array([1]), 2, ["scan", "vel"])
    assert windows.steps.dtype == np.float32
    for term, expected in enumerate((scan[0], scan[0] / 2)):
        error = np.abs(windows.observation["scan"][term, 0].astype(np.float64) - expected)
        assert error.max() <= 2.0**-7  # half of the spacing from 16 m to 32 m
        assert (error <= expected * 2.0**-11 + 1e-12).all()
    np.testing.assert_array_equal(windows.observation["vel"][:, 0], np.stack([velocity[0], velocity[0] / 3]))


def test_other_terms_may_be_stored_in_half_precision() -> None:
    buffer = ReplayBuffer(10, space(scan=4, vel=3), 2, 1, half_precision=["vel"])
    assert (buffer.observation["scan"].dtype, buffer.observation["vel"].dtype) == (np.float32, np.float16)


def test_what_is_read_is_a_copy() -> None:
    buffer = by_hand()
    batch = gather(buffer, np.array([4]), history=2, n_steps=1)
    windows = windows_of(buffer, np.array([4]), 2, ["vel"])
    for values in (*batch.observation.values(), *batch.next_observation.values(), *windows.observation.values()):
        values[...] = 99.0
    windows.action[...] = batch.action[...] = 99.0
    after = windows_of(buffer, np.array([4, 6]), 2, ["vel"])
    assert after.observation["vel"][:, :, 0].T.tolist() == [[11, 12], [12, 13]]
    np.testing.assert_allclose(after.action[:, :, 0].T, [[0.11, 0.12], [0.12, 0.13]], rtol=1e-6)


# Mistakes.


def test_adding_before_an_episode_has_begun_is_an_error() -> None:
    buffer = ReplayBuffer(100, VEL, 1, 2)
    with pytest.raises(OutlapError, match="call begin first"):
        add(buffer, [0], [1], [0])
    begin(buffer, [0], [1], ["task"])
    with pytest.raises(OutlapError, match="call begin first"):
        add(buffer, [0, 1], [1, 2], [0, 0])
    assert buffer.added == 1


def test_a_capacity_too_small_is_an_error() -> None:
    with pytest.raises(OutlapError, match="capacity is 11; 4 worlds need at least 12 rows"):
        ReplayBuffer(11, VEL, 1, 4)
    ReplayBuffer(12, VEL, 1, 4)


@pytest.mark.parametrize("by_task", [False, True])
def test_drawing_from_an_empty_buffer_is_an_error(by_task: bool) -> None:
    buffer = ReplayBuffer(100, VEL, 1, 1)
    with pytest.raises(OutlapError, match="no transition yet"):
        buffer.sample(1, np.random.default_rng(0), by_task=by_task)
    begin(buffer, [0], [1], ["task"])  # a row, but nothing after it
    with pytest.raises(OutlapError, match="no transition yet"):
        buffer.sample(1, np.random.default_rng(0), by_task=by_task)


# Steps of an environment.


def fake_env(*reset_infos: Mapping[str, object]) -> VecEnv:
    return cast(VecEnv, SimpleNamespace(num_envs=len(reset_infos), reset_infos=list(reset_infos)))


def test_the_task_of_an_info_is_its_task_or_else_its_track() -> None:
    assert task_of({"task": "wet", "track": "ring"}) == "wet"
    assert task_of({"track": "ring"}) == "ring"
    assert task_of({"lap": 3}) is None


def test_a_step_that_ends_episodes_stores_where_they_ended_and_begins_the_next() -> None:
    buffer = ReplayBuffer(100, VEL, 1, 4)
    begin_episodes(buffer, fake_env({"track": "a"}, {"track": "b"}, {"track": "a"}, {"track": "c"}), vel(1, 2, 3, 4))
    assert buffer.tasks == ["a", "b", "c"]
    # World 0 terminates, 1 is cut short, 2 goes on, 3 terminates and says so.
    env = fake_env({"track": "d"}, {"track": "e"}, {"track": "not begun"}, {"track": "a"})
    observation = vel(100, 200, 30, 400)
    infos = [
        {"terminal_observation": {"vel": np.array([10.0])}},
        {"terminal_observation": {"vel": np.array([20.0])}, "TimeLimit.truncated": True},
        {},
        {"terminal_observation": {"vel": np.array([40.0])}, "TimeLimit.truncated": False},
    ]
    action, reward = np.array([[0.1], [0.2], [0.3], [0.4]]), np.array([1.0, 2.0, 3.0, 4.0])
    add_step(buffer, env, observation, action, reward, np.array([True, True, False, True]), infos)
    np.testing.assert_array_equal(observation["vel"][:, 0], [100, 200, 30, 400])  # the caller's is untouched

    batch = gather(buffer, np.arange(4), history=1, n_steps=1, gamma=0.5, terms=["vel"])
    assert batch.observation["vel"][:, 0].tolist() == [1, 2, 3, 4]
    assert batch.next_observation["vel"][:, 0].tolist() == [10, 20, 30, 40]
    assert batch.discount.tolist() == [0.0, 0.5, 0.5, 0.0]
    assert batch.reward.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(batch.action[:, 0], [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    assert [buffer.tasks[task] for task in batch.task] == ["a", "b", "a", "c"]

    assert buffer.added == 11  # three rows more, of the episodes that begin
    newest = windows_of(buffer, buffer.latest, 2, ["vel"])
    assert newest.observation["vel"][:, :, 0].T.tolist() == [[0, 100], [0, 200], [3, 30], [0, 400]]
    assert buffer.reward[buffer.latest].tolist() == [0, 0, 3, 0]

    quiet = fake_env(*[{"track": "not begun"}] * 4)
    add_step(buffer, quiet, vel(101, 201, 31, 401), action, reward, np.zeros(4, bool), [{}] * 4)
    assert buffer.added == 15
    assert buffer.tasks == ["a", "b", "c", "d", "e"]
    assert [buffer.transitions(task) for task in buffer.tasks] == [4, 1, 1, 1, 1]


def test_rewards_are_read_with_the_present_scales(tmp_path: Path):
    """Two steps of 1 + 10 a, then 2 + 20 a + 5 b, by hand, at two scales; saved and loaded too."""
    buffer = ReplayBuffer(20, VEL, 1, 1, curriculum_terms=2)
    begin(buffer, [0], [1], ["task"])
    for reward, terms in ((1.0, [10.0, 0.0]), (2.0, [20.0, 5.0])):
        buffer.add(np.array([0]), vel(0.0), np.zeros((1, 1)), np.array([reward]), np.zeros(1, bool), np.array([terms]))
    first = np.array([0])
    assert gather(buffer, first, history=1, n_steps=2, gamma=0.5).reward.tolist() == [1.0 + 0.5 * 2.0]
    buffer.scales = np.array([0.1, 2.0])
    expected = [1.0 + 1.0 + 0.5 * (2.0 + 2.0 + 10.0)]
    assert gather(buffer, first, history=1, n_steps=2, gamma=0.5).reward.tolist() == expected
    again = ReplayBuffer.load(buffer.save(tmp_path / "replay.npz"))
    assert gather(again, first, history=1, n_steps=2, gamma=0.5).reward.tolist() == expected


def test_a_crash_that_is_kept_costs_what_a_crash_costs_now():
    """Cars crash when the penalty is 1; drawn when it is 8, the same rows cost 8, and no other row changes."""
    reward = {"weights": {"progress": 1.0, "collision": 2.0}, "collision_max": 8.0}
    env = ContextVecEnv(make_sb3(8, tracks=[ring(5.0)], beams=0, reward=reward, observation="vel", control_interval=5))
    env.set_attr("training_progress", 0.0)
    assert isinstance(env.observation_space, gym.spaces.Dict)
    buffer = ReplayBuffer(10_000, env.observation_space, 2, 8, curriculum_terms=2)
    env.seed(0)
    begin_episodes(buffer, env, cast("dict[str, np.ndarray]", env.reset()))
    given: list[np.ndarray] = []
    for _ in range(60):
        observation, rewards, dones, infos = env.step(np.tile([0.6, 0.2], (8, 1)))
        add_step(buffer, env, cast("dict[str, np.ndarray]", observation), np.zeros((8, 2)), rewards, dones, infos)
        given.append(rewards)
    serial = np.concatenate([recent.at(np.arange(recent.count(0)), 0) for recent in buffer._departures])
    then = gather(buffer, serial, history=1)
    assert np.sort(then.reward) == pytest.approx(np.sort(np.concatenate(given)), abs=1e-5)
    crashed = then.discount == 0.0
    assert 8 <= crashed.sum() < len(crashed)
    env.set_attr("training_progress", 1.0)
    observation, rewards, dones, infos = env.step(np.zeros((8, 2)))
    add_step(buffer, env, cast("dict[str, np.ndarray]", observation), np.zeros((8, 2)), rewards, dones, infos)
    now = gather(buffer, serial, history=1)
    np.testing.assert_allclose(now.reward - then.reward, np.where(crashed, -2.0 * (8.0 - 1.0), 0.0), atol=1e-5)


def test_a_reward_that_a_wrapper_changed_is_kept_as_it_is():
    inner = make_sb3(4, tracks=[ring(5.0)], beams=0, observation="vel", control_interval=5)
    env = ContextVecEnv(VecNormalize(inner, norm_obs=False))
    assert isinstance(env.observation_space, gym.spaces.Dict)
    buffer = ReplayBuffer(10_000, env.observation_space, 2, 4, curriculum_terms=2)
    env.seed(0)
    begin_episodes(buffer, env, cast("dict[str, np.ndarray]", env.reset()))
    for _ in range(40):
        observation, rewards, dones, infos = env.step(np.tile([0.6, 0.2], (4, 1)))
        add_step(buffer, env, cast("dict[str, np.ndarray]", observation), np.zeros((4, 2)), rewards, dones, infos)
    assert not buffer.curriculum.any()
    assert (buffer.terminated & (buffer.reward != 0.0)).any()
