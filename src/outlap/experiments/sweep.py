"""A search for hyper-parameters: a small YAML file says what is varied, and what a trial is judged by.

algorithm: mql
training: {total_steps: 200000}
search:
  learning_rate: {log_uniform: [1.0e-4, 3.0e-3]}
  env.reward.collision_max: [1, 5, 10]
trials: 12
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, field_validator

from outlap.config import Config, validate
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.evaluation.results import ROWS
from outlap.experiments.definitions import merge
from outlap.experiments.plan import PAPER_REWARD, training_class
from outlap.experiments.paper_units import RaceUnit, Task, TrainingUnit
from outlap.files import to_json
from outlap.track.generate import BUILTIN_TRAIN
from outlap.training.session import TrainingConfig

Distribution = Literal["uniform", "log_uniform", "integer"]


class Range(Config):
    """Values to draw from."""

    distribution: Distribution
    low: float
    high: float

    def draw(self, rng: np.random.Generator) -> float | int:
        """One of them."""
        match self.distribution:
            case "uniform":
                return float(rng.uniform(self.low, self.high))
            case "log_uniform":
                return float(math.exp(rng.uniform(math.log(self.low), math.log(self.high))))
            case "integer":
                return int(rng.integers(int(self.low), int(self.high), endpoint=True))


class SweepConfig(Config):
    """What is varied, and how trials are judged."""

    algorithm: str
    training: dict[str, Any] = Field(default={})  # of all trials: what differs from the algorithm's defaults
    search: dict[str, tuple[Any, ...] | Range] = Field(min_length=1)  # by field, dots between those inside each other
    trials: int = Field(default=0, ge=0)  # drawn at random; 0: every combination, of lists alone
    seeds: int = Field(default=1, ge=1)  # trainings of every trial
    seed: int = Field(default=0, ge=0)  # of the draws
    # Where policies race to be judged; none: where they trained. Held-out circuits are for tests alone.
    tracks: tuple[str, ...] = ()
    episodes: int = Field(default=40, ge=1)  # of every trial and seed, all tracks together
    time_limit: float = Field(default=20.0, gt=0)  # [s] of an episode

    @field_validator("search", mode="before")
    @classmethod
    def _read_ranges(cls, search: Any) -> Any:
        return {name: _range(name, value) for name, value in search.items()} if isinstance(search, Mapping) else search

    def draw(self) -> list[dict[str, Any]]:
        """The values of every trial, by field. Raises OutlapError where all combinations are wanted of a range."""
        if self.trials:
            rng = np.random.default_rng(self.seed)
            return [
                {name: each.draw(rng) if isinstance(each, Range) else each[rng.integers(len(each))]
                 for name, each in self.search.items()}
                for _ in range(self.trials)
            ]  # fmt: skip
        for name, each in self.search.items():
            if isinstance(each, Range):
                raise OutlapError(f"search.{name} is a range, of which trials are drawn; say how many by trials")
        return [dict(zip(self.search, values, strict=True)) for values in itertools.product(*self.search.values())]

    def trial_config(self, values: Mapping[str, Any], seed: int = 0, **also: Any) -> TrainingConfig:
        """The training of a trial. Raises OutlapError that names a field which is wrong."""
        cls = training_class(self.algorithm)
        content = merge(cls().model_dump(mode="json"), self.training, {"seed": seed, "threads": 1, **also})
        for name, value in values.items():
            content = merge(content, _nested(name, value))
        return validate(cls, content, f"trial with {', '.join(f'{name} {value}' for name, value in values.items())}")


@dataclass(frozen=True)
class Trial:
    """Values, and what is done to judge them."""

    number: int
    values: Mapping[str, Any]
    races: tuple[RaceUnit, ...]  # one a seed

    @property
    def config(self) -> TrainingConfig:
        """Of its first seed."""
        assert self.races[0].training is not None
        return self.races[0].training.config


def plan_trials(sweep: SweepConfig) -> list[Trial]:
    """The trials of a sweep. Raises OutlapError for a trial whose training is not valid."""
    trials = []
    for number, values in enumerate(sweep.draw()):
        races = []
        # Not its number: other values before it would change that, and a unit with another name is done anew.
        trial = f"trial-{hashlib.sha256(to_json(sweep.trial_config(values)).encode()).hexdigest()[:8]}"
        for seed in range(sweep.seeds):
            name = f"{trial}-{seed}"
            config = sweep.trial_config(values, seed)
            tracks = sweep.tracks or config.env.tracks or BUILTIN_TRAIN
            races.append(
                RaceUnit(
                    name=name,
                    method=trial,
                    task_set="sweep",
                    table="sweep",
                    seed=seed,
                    env=config.env,
                    tasks=tuple(Task(track, track) for track in tracks),
                    episodes=-(-sweep.episodes // len(tracks)),
                    time_limit=sweep.time_limit,
                    score=PAPER_REWARD,
                    training=TrainingUnit(name, config),
                )
            )
        trials.append(Trial(number, values, tuple(races)))
    return trials


def judge(trials: Sequence[Trial], work: Path) -> pd.DataFrame:
    """A row a trial that is done, the best first: its number, values, and over seeds and episodes the mean progress.

    Columns: trial, every field that is varied, progress_m, progress_low_m and progress_high_m (the worst and the best
    seed), crash_rate, mean_speed_mps.
    """
    found = []
    for trial in trials:
        raced = [pd.read_parquet(race.folder(work) / ROWS) for race in trial.races]
        progress = np.array([rows["progress_m"].to_numpy().mean() for rows in raced])  # of each seed
        everything = pd.concat(raced)
        found.append(
            {
                "trial": trial.number,
                **trial.values,
                "progress_m": progress.mean(),
                "progress_low_m": progress.min(),
                "progress_high_m": progress.max(),
                "crash_rate": np.mean(everything["outcome"].to_numpy() == CRASH),
                "mean_speed_mps": everything["mean_speed_mps"].to_numpy().mean(),
            }
        )
    return pd.DataFrame(found).sort_values("progress_m", ascending=False, kind="stable", ignore_index=True)


def _range(name: str, value: Any) -> Any:
    """A list of choices as it is, {uniform: [low, high]} as a range."""
    if isinstance(value, (list, tuple)):
        if not value:
            raise ValueError(f"{name} has no values")
        return tuple(value)
    if isinstance(value, Range):
        return value
    rule = "must be a list of values, or one of {uniform: [low, high]}, {log_uniform: ...}, {integer: ...}"
    if not isinstance(value, Mapping) or len(value) != 1:
        raise ValueError(f"{name} {rule}")
    ((distribution, ends),) = value.items()
    if distribution not in ("uniform", "log_uniform", "integer"):
        raise ValueError(f"{name} {rule}")
    try:
        low, high = (float(end) for end in ends)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {distribution} must have two numbers, [low, high]") from None
    if not low < high or (distribution == "log_uniform" and low <= 0.0):
        raise ValueError(f"{name}: {distribution} must have low < high{', both > 0' * (distribution == 'log_uniform')}")
    return Range(distribution=distribution, low=low, high=high)


def _nested(name: str, value: Any) -> dict[str, Any]:
    """a.b.c and a value as mappings inside each other."""
    first, _, rest = name.partition(".")
    return {first: _nested(rest, value) if rest else value}
