"""What a search for hyper-parameters varies, and how it judges trials: a small YAML file.

algorithm: mql
training: {total_steps: 200000}
search:
  learning_rate: {log_uniform: [1.0e-4, 3.0e-3]}
  env.reward.collision_max: [1, 5, 10]
trials: 12
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Literal

from pydantic import Field, field_validator

from outlap.config import Config, validate
from outlap.experiments.definitions import merge
from outlap.experiments.plan import training_class
from outlap.training.config import TrainingConfig

Distribution = Literal["uniform", "log_uniform", "integer"]


class Range(Config):
    """A range of values, and how they are distributed."""

    distribution: Distribution
    low: float
    high: float


class SearchConfig(Config):
    """What is varied, and how trials are judged."""

    algorithm: str
    training: dict[str, Any] = Field(default={})  # of all trials: what differs from the algorithm's defaults
    search: dict[str, tuple[Any, ...] | Range] = Field(min_length=1)  # by field, with dots between nested fields
    trials: int = Field(default=0, ge=0)  # to draw; 0: every combination, if all are lists
    sampler: Literal["random", "tpe"] = "random"  # tpe: draw near the best trials so far
    seed: int = Field(default=0, ge=0)  # of the draws
    seeds: int = Field(default=1, ge=1)  # trainings of every trial
    # Shares of the steps after which trials are compared. A trial continues if it is among the best 1/reduction_factor
    # of those that came so far (asynchronous successive halving); none: all trials are trained to the end.
    rungs: tuple[float, ...] = ()
    reduction_factor: int = Field(default=4, ge=2)
    # Where policies race to be judged; none: where they trained. Held-out circuits are for tests alone.
    tracks: tuple[str, ...] = ()
    episodes: int = Field(default=40, ge=1)  # of every trial and seed, all tracks together
    time_limit: float = Field(default=20.0, gt=0)  # [s] of an episode

    @field_validator("search", mode="before")
    @classmethod
    def _read_ranges(cls, search: Any) -> Any:
        return {name: _range(name, value) for name, value in search.items()} if isinstance(search, Mapping) else search

    @field_validator("rungs")
    @classmethod
    def _check_rungs(cls, rungs: tuple[float, ...]) -> tuple[float, ...]:
        if not all(low < high for low, high in pairwise((0.0, *rungs, 1.0))):
            raise ValueError("must be shares of the steps in increasing order, such as [0.125, 0.5]")
        return rungs

    def trial_config(self, values: Mapping[str, Any], seed: int = 0) -> TrainingConfig:
        """Return the training of a trial. Raise OutlapError that names a wrong field."""
        cls = training_class(self.algorithm)
        content = merge(cls().model_dump(mode="json"), self.training, {"seed": seed, "threads": 1})
        for name, value in values.items():
            content = merge(content, _nested(name, value))
        return validate(cls, content, f"trial with {', '.join(f'{name} {value}' for name, value in values.items())}")


def _range(name: str, value: Any) -> Any:
    """Return a list of choices as it is, and {uniform: [low, high]} as a range."""
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
    """Return a.b.c and a value as nested mappings."""
    first, _, rest = name.partition(".")
    return {first: _nested(rest, value) if rest else value}
