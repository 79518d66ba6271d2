"""Replay for a learner with a memory: every step is stored once, windows are gathered by index.

A row is what a learner knows at one moment: the observation, and the action and the reward that led to it. Rows
have serial numbers in the order in which they were added; a ring of `capacity` rows keeps the newest. Each row
names the row before it and the one after it in its episode, so that episodes of many worlds may lie mixed, and a
window stops where its episode began or where older rows are gone.

A reward may have terms whose scales change over a training. A row keeps them unscaled, beside the rest of its reward;
what is read is scaled as the newest rows are, so that a crash costs what it costs at present, whenever it happened.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from numba import njit
from torch import Tensor

from outlap.errors import OutlapError, brief
from outlap.files import replacing
from outlap.mql.batch import Batch, Windows
from outlap.mql.recent import Recent, grown

NONE = -1  # serial of no row


TaskName = str | int | None  # None where an environment names no task


class ReplayBuffer:
    """Flat storage of the steps of many worlds, and an index of the newest transitions of every task."""

    def __init__(
        self,
        capacity: int,
        observation_space: gym.spaces.Dict,
        action_size: int,
        num_worlds: int,
        *,
        half_precision: Sequence[str] = ("scan",),
        task_capacity: int | None = None,
        curriculum_terms: int = 0,
    ) -> None:
        """Reserve the memory; it is taken as rows come in.

        Args:
            capacity: rows; an episode of n transitions has n + 1.
            observation_space: Dict of one-dimensional terms.
            action_size: numbers in an action.
            num_worlds: that add a row at each step.
            half_precision: terms stored as float16 (a range of 30 m to 8 mm).
            task_capacity: newest transitions of each task that `sample` may draw; None: all that are kept.
            curriculum_terms: of the reward, whose scales change.

        Raises OutlapError for a capacity that cannot hold one transition of each world.
        """
        if capacity < 3 * num_worlds:
            raise OutlapError(
                f"replay: capacity is {capacity}; {num_worlds} worlds need at least {3 * num_worlds} rows"
            )
        self.capacity = capacity
        self.task_capacity = task_capacity or capacity
        self.observation = {
            name: np.zeros((capacity, *box.shape), np.float16 if name in half_precision else np.float32)  # type: ignore[misc]
            for name, box in observation_space.spaces.items()
        }
        self.action = np.zeros((capacity, action_size), np.float32)
        self.reward = np.zeros(capacity, np.float32)  # without the terms of `curriculum`
        self.curriculum = np.zeros((capacity, curriculum_terms), np.float32)  # terms of the reward, unscaled
        self.scales = np.zeros(curriculum_terms)  # of these terms at present
        self.terminated = np.zeros(capacity, bool)
        self.before = np.full(capacity, NONE)  # serial of the row before in the episode
        self.after = np.full(capacity, NONE)
        self.task = np.zeros(capacity, np.int64)
        self.added = 0  # rows so far: the next serial
        self.forget_worlds(num_worlds)
        self.tasks: list[TaskName] = []
        self._numbers: dict[TaskName, int] = {}
        self._departures: list[Recent] = []  # of every task: rows that have a row after them

    @property
    def num_worlds(self) -> int:
        """Worlds that add rows."""
        return len(self.latest)

    @property
    def oldest(self) -> int:
        """Serial of the oldest row that is kept."""
        return max(0, self.added - self.capacity)

    def transitions(self, task: TaskName = None) -> int:
        """How many transitions can be drawn, of one named task or, by default, of all."""
        which = self._departures if task is None else [self._departures[self._numbers[task]]]
        return sum(recent.count(self.oldest) for recent in which)

    def forget_worlds(self, num_worlds: int) -> None:
        """Keep all rows, and let so many worlds begin anew."""
        self.latest = np.full(num_worlds, NONE)  # serial of each world's newest row
        self.task_now = np.zeros(num_worlds, np.int64)  # of each world: its position in `tasks`

    def begin(self, worlds: np.ndarray, observation: Mapping[str, np.ndarray], tasks: Sequence[TaskName]) -> None:
        """Add the first row of an episode in some worlds.

        Args:
            worlds: (n,) their numbers.
            observation: (n, size) of each term.
            tasks: of each of these worlds from now on.
        """
        for task in tasks:
            if task not in self._numbers:
                self._numbers[task] = len(self.tasks)
                self.tasks.append(task)
                self._departures.append(Recent(self.task_capacity))
        numbers = np.array([self._numbers[task] for task in tasks], np.int64)
        zero = np.zeros(len(worlds), np.float32)
        action = np.zeros((len(worlds), self.action.shape[1]), np.float32)
        self.task_now[worlds] = numbers
        none = np.full(len(worlds), NONE)
        self._add(np.asarray(worlds), observation, action, zero, zero > 0, none, numbers, 0.0)

    def add(
        self,
        worlds: np.ndarray,
        observation: Mapping[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
        curriculum: np.ndarray | float = 0.0,
    ) -> None:
        """Add the next row of some worlds: one transition each.

        Args:
            worlds: (n,) their numbers; each has begun an episode.
            observation: (n, size) of each term, that the action led to; an episode's last one too.
            action: (n, actions).
            reward: (n,), without the terms of `curriculum`.
            terminated: bool (n,): the episode is over, and not cut short.
            curriculum: (n, terms) that `scales` multiplies when the reward is read.
        """
        worlds = np.asarray(worlds)
        before = self.latest[worlds]
        if (before == NONE).any():
            raise OutlapError("replay: a world has no episode; call begin first")
        tasks = self.task_now[worlds]
        self._add(worlds, observation, action, reward, terminated, before, tasks, curriculum)
        kept = before >= self.oldest
        self.after[before[kept] % self.capacity] = self.latest[worlds[kept]]
        for number in np.unique(tasks):
            self._departures[number].extend(np.sort(before[tasks == number]))

    def sample(self, n: int, rng: np.random.Generator, *, by_task: bool = False) -> np.ndarray:
        """Draw transitions: serials int64 (n,) of the rows that they depart from, for `gather`.

        Args:
            n: how many.
            rng: draws them.
            by_task: every task as likely as any other, and within it every transition; otherwise every transition.

        Raises OutlapError where there is none.
        """
        counts = np.array([recent.count(self.oldest) for recent in self._departures])
        if not counts.sum():
            raise OutlapError("replay: holds no transition yet")
        chances = (counts > 0) / (counts > 0).sum() if by_task else counts / counts.sum()
        of_task = rng.multinomial(n, chances)
        places = np.split(rng.integers(0, np.repeat(counts, of_task)), np.cumsum(of_task)[:-1])
        drawn = [
            recent.at(place, self.oldest) for recent, place in zip(self._departures, places, strict=True) if len(place)
        ]
        return np.concatenate(drawn)

    def windows(self, serial: np.ndarray, length: int, terms: Sequence[str]) -> Windows:
        """The last `length` rows of an episode up to and with each of some rows.

        Args:
            serial: (n,) of rows that are kept.
            length: rows of a window.
            terms: of the observation that are wanted.
        """
        rows, _, _ = self._positions(serial, length, 0, 1.0)
        return self._read(rows, terms)

    def gather(
        self, serial: np.ndarray, *, history: int, n_steps: int = 1, gamma: float = 0.99, terms: Sequence[str] = ()
    ) -> Batch:
        """Transitions with their windows.

        Args:
            serial: (n,) from `sample`.
            history: rows of a window.
            n_steps: steps that a transition spans, fewer where the episode ends or nothing newer is there.
            gamma: discount of a step.
            terms: of the observation that the windows hold.
        """
        rows, steps, reward = self._positions(serial, history, n_steps, gamma)
        departure, arrival = rows[history - 1], rows[-1]
        ends = torch.from_numpy(np.concatenate([departure, arrival]))
        seen = {name: _select(column, ends) for name, column in self.observation.items()}
        n = len(departure)
        return Batch(
            serial=np.asarray(serial),
            task=self.task[departure],
            windows=self._read(rows, terms),
            observation={name: term[:n] for name, term in seen.items()},
            next_observation={name: term[n:] for name, term in seen.items()},
            action=_select(self.action, torch.from_numpy(rows[history])),
            reward=torch.from_numpy(reward),
            discount=torch.from_numpy(np.where(self.terminated[arrival], 0.0, gamma**steps).astype(np.float32)),
            steps=torch.from_numpy(steps),
        )

    def _positions(
        self, serial: np.ndarray, history: int, n_steps: int, gamma: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `_trace`."""
        given = np.asarray(serial, np.int64), self.before, self.after, self.reward, self.curriculum, self.scales
        return _trace(*given, self.oldest, history, n_steps, gamma)

    def _read(self, rows: np.ndarray, terms: Sequence[str]) -> Windows:
        sources = [self.action, *(self.observation[name] for name in terms)]
        ends = np.cumsum([source.shape[1] for source in sources]).tolist()
        valid, index = torch.from_numpy(rows != NONE), torch.from_numpy(rows.clip(min=0).ravel())
        steps = torch.empty(rows.size, ends[-1])
        for source, end in zip(sources, ends, strict=True):
            steps[:, end - source.shape[1] : end] = _select(source, index)
        steps.masked_fill_(~valid.view(-1, 1), 0.0)
        columns = {name: slice(*place) for name, place in zip(terms, pairwise(ends), strict=True)}
        return Windows(steps.view(*rows.shape, ends[-1]), columns, valid)

    def _add(self, worlds, observation, action, reward, terminated, before, tasks, curriculum) -> None:
        serial = self.added + np.arange(len(worlds))
        rows = serial % self.capacity
        for name, column in self.observation.items():
            column[rows] = observation[name]
        self.action[rows] = action
        self.reward[rows] = reward
        self.curriculum[rows] = curriculum
        self.terminated[rows] = terminated
        self.before[rows] = before
        self.after[rows] = NONE
        self.task[rows] = tasks
        self.latest[worlds] = serial
        self.added += len(worlds)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all that is kept, the rows in use only; a kill leaves the old file or the new one. No pickle."""
        used = min(self.added, self.capacity)
        arrays = {name: getattr(self, name)[:used] for name in ROW_FIELDS}
        arrays |= {f"observation/{name}": column[:used] for name, column in self.observation.items()}
        arrays |= {"latest": self.latest, "task_now": self.task_now, "scales": self.scales}
        facts = {
            "capacity": self.capacity,
            "task_capacity": self.task_capacity,
            "added": self.added,
            "tasks": self.tasks,
            "departures": [(recent.added, recent.ascending) for recent in self._departures],
        }
        for number, recent in enumerate(self._departures):
            arrays[f"departures/{number}"] = recent.ring[: min(recent.added, len(recent.ring))]
        arrays["facts"] = np.frombuffer(json.dumps(facts).encode(), np.uint8)
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        return Path(path)

    def _check_columns(self) -> None:
        """Raises ValueError for columns that kernels do not read."""
        for name, (kind, axes) in ROW_FIELDS.items():
            column = getattr(self, name)
            if column.dtype != kind or column.ndim != axes:
                raise ValueError(f"{name} is {column.dtype} with {column.ndim} axes")
        if self.scales.dtype != np.float64 or self.scales.shape != self.curriculum.shape[1:]:
            raise ValueError(f"scales are {self.scales.dtype} {self.scales.shape}")
        for name, column in self.observation.items():
            if column.dtype not in (np.float16, np.float32) or column.ndim != 2:
                raise ValueError(f"observation/{name} is {column.dtype} with {column.ndim} axes")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ReplayBuffer:
        """Read what `save` wrote; runs no code from the file. Raises OutlapError where it is missing or broken."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            facts = json.loads(arrays.pop("facts").tobytes())
            buffer = cls.__new__(cls)
            buffer.capacity, buffer.task_capacity = int(facts["capacity"]), int(facts["task_capacity"])
            buffer.added = int(facts["added"])
            buffer.latest, buffer.task_now, buffer.scales = (arrays[name] for name in ("latest", "task_now", "scales"))
            buffer.tasks = facts["tasks"]
            buffer._numbers = {task: number for number, task in enumerate(buffer.tasks)}
            buffer.observation = {
                name.removeprefix("observation/"): grown(column, buffer.capacity)
                for name, column in arrays.items()
                if name.startswith("observation/")
            }
            for name in ROW_FIELDS:
                setattr(buffer, name, grown(arrays[name], buffer.capacity))
            buffer._check_columns()
            buffer._departures = []
            for number, (added, ascending) in enumerate(facts["departures"]):
                recent = Recent(buffer.task_capacity)
                recent.ring = arrays[f"departures/{number}"]
                recent.added, recent.ascending = int(added), bool(ascending)
                buffer._departures.append(recent)
        except Exception as error:  # whatever a broken archive raises
            raise OutlapError(f"{path}: cannot be read as a replay: {brief(error)}") from error
        return buffer


ROW_FIELDS = {  # type of number and axes
    "action": (np.float32, 2), "reward": (np.float32, 1), "curriculum": (np.float32, 2), "terminated": (np.bool_, 1),
    "before": (np.int64, 1), "after": (np.int64, 1), "task": (np.int64, 1),
}  # fmt: skip


def _select(column: np.ndarray, rows: Tensor) -> Tensor:
    """Copy rows of a column, as float32."""
    return torch.from_numpy(column).index_select(0, rows).float()


@njit(cache=True)
def _trace(serial, before, after, reward, curriculum, scales, oldest, history, n_steps, gamma):
    """Where the rows of transitions lie that depart from some rows.

    Returns:
        Positions int64 (history + n_steps, n) of the rows that lead to the departure and on, NONE before the episode
        or the ring began, the last one repeated behind the episode's end; int64 (n,) steps that there are, up to
        n_steps; float32 (n,) the discounted sum of their rewards.
    """
    n, capacity = len(serial), len(before)
    rows = np.full((history + n_steps, n), NONE)
    steps, returns = np.zeros(n, np.int64), np.zeros(n)
    # Step by step, and not transition by transition: so the waits for memory overlap.
    here = serial.copy()
    for t in range(history - 1, -1, -1):
        for i in range(n):
            if here[i] != NONE:
                rows[t, i] = here[i] % capacity
                there = before[rows[t, i]]
                here[i] = there if there >= oldest else NONE
    here[:] = serial
    for t in range(n_steps):
        for i in range(n):
            there = after[here[i] % capacity]
            if there != NONE:
                here[i] = there
                steps[i] += 1
                gained = float(reward[there % capacity])
                for k in range(len(scales)):
                    gained += scales[k] * curriculum[there % capacity, k]
                returns[i] += gamma**t * gained
            rows[history + t, i] = here[i] % capacity
    return rows, steps, returns.astype(np.float32)
