"""Reward terms, a function a term, and the presets that weigh them.

A term is unweighted: (worlds,) float of one car. The reward is the sum of weight × scale × term, where the scale of a
term with a curriculum depends on the training's progress, 0 … 1; other terms have none. Constants: `RewardConfig`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from outlap.config import Config
from outlap.envs.race import Race
from outlap.envs.terminations import STALLED

CURRICULUM_END = 1.0  # progress of a finished training; environments outside of a training stand here
IN_STEPS = {  # constants of earlier versions, in environment steps, and what replaces them
    "collision_steps": "collision_growth",
    "velocity_step": "velocity_fade",
    "velocity_width": "velocity_fade_width",
}


class RewardConfig(Config):
    """Which terms count, how much, and their constants.

    Curricula depend on the share of the training that is done, 0 … 1, so that a longer training has the same ones.
    """

    preset: Literal["fast", "paper"] = "fast"  # where weights come from
    weights: dict[str, float] = Field(default={})  # by term, in place of the preset's
    milestones: int = Field(default=10, ge=1)  # per lap
    collision_min: float = Field(default=1.0, ge=0)  # the collision penalty when training begins
    collision_max: float = Field(default=10.0, ge=0)  # and when it ends; equal to `collision_min` it never grows
    collision_growth: float | None = Field(default=None, gt=0, le=10)  # share of training, see `collision_penalty`
    velocity_fade: float = Field(default=1 / 3, ge=0, le=1)  # share of training at which velocity matching has halved
    velocity_fade_width: float = Field(default=1 / 30, gt=0, le=1)  # share of training over which it falls

    @model_validator(mode="before")
    @classmethod
    def _from_preset_name(cls, value: Any) -> Any:
        return {"preset": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _penalty_never_falls(self) -> RewardConfig:
        if self.collision_max < self.collision_min:
            raise ValueError(
                f"collision_max is {self.collision_max:g}; must be at least collision_min, {self.collision_min:g}"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _refuse_steps(cls, value: Any) -> Any:
        given: Any = value
        for name, now in IN_STEPS.items() if isinstance(given, dict) else ():
            if name in given:
                raise ValueError(
                    f"{name} counts environment steps, which curricula no longer do; "
                    f"give {now} = {name} / total_steps, a share of the training"
                )
        return value

    @field_validator("weights")
    @classmethod
    def _known_terms(cls, weights: dict[str, float]) -> dict[str, float]:
        for name in weights:
            if name not in REWARD_TERMS:
                raise ValueError(f"{name!r} is not a reward term; there are {', '.join(REWARD_TERMS)}")
        return weights

    def without_curricula(self) -> RewardConfig:
        """The reward for the end of the curricula, without the term that is zero then: it needs planned lines."""
        return self.model_copy(update={"weights": {**self.weights, "velocity_matching": 0.0}})

    def resolved(self) -> dict[str, float]:
        """The weight of every term that counts."""
        weights = {**REWARD_PRESETS[self.preset], **self.weights}
        return {name: weight for name, weight in weights.items() if weight != 0.0}


def milestone(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """Milestones passed for the first time: one at each 1 / milestones of a lap from the start."""
    step = race.length / config.milestones
    passed = np.floor((race.farthest[:, car] - race.start[:, car]) / step)
    return passed - np.floor((race.farthest_before[:, car] - race.start[:, car]) / step)


def progress(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """Advance along the centreline [m]."""
    return race.distance[:, car] - race.distance_before[:, car]


def lap_progress(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """Advance along the centreline [laps]."""
    return progress(race, car, config) / race.length


def collision(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-1 where the car crashed, scaled by `collision_penalty`."""
    return -race.crashed[:, car].astype(np.float64)


def stall(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-1 where the episode ends because the car gets no further: else a careful policy would rather stand."""
    return -(race.outcome[:, car] == STALLED).astype(np.float64)


def velocity_matching(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-(v - v_ref)^2 [m^2/s^2], scaled by `velocity_weight`; v_ref is the speed on the minimum-time line."""
    assert race.reference is not None  # the environment has it where this term counts
    reference = race.reference.at(car, race.worlds.track, race.line_rows(car, np.zeros(1))[:, 0])
    return -((race.speed[:, car] - reference) ** 2)


def steering_change(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-|change of the steering action|."""
    return -np.abs(race.actions[:, car, 0] - race.actions_before[:, car, 0])


def speed_change(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-|change of the speed action|."""
    return -np.abs(race.actions[:, car, 1] - race.actions_before[:, car, 1])


def overtake(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """Places gained."""
    return race.places_gained[:, car].astype(np.float64)


def overtaken(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-Places lost."""
    return -race.places_lost[:, car].astype(np.float64)


REWARD_TERMS: dict[str, Callable[[Race, int, RewardConfig], np.ndarray]] = {
    "milestone": milestone,
    "progress": progress,
    "lap_progress": lap_progress,
    "collision": collision,
    "stall": stall,
    "velocity_matching": velocity_matching,
    "steering_change": steering_change,
    "speed_change": speed_change,
    "overtake": overtake,
    "overtaken": overtaken,
}


def collision_penalty(progress: float, config: RewardConfig) -> float:
    """c_min + (c_max - c_min) tanh(p / T) / tanh(1 / T): T is `collision_growth`, or the preset's."""
    growth = COLLISION_GROWTH[config.preset] if config.collision_growth is None else config.collision_growth
    share = math.tanh(progress / growth) / math.tanh(1.0 / growth)
    return config.collision_min + (config.collision_max - config.collision_min) * share


def velocity_weight(progress: float, config: RewardConfig) -> float:
    """1 / (1 + exp((p - `velocity_fade`) / `velocity_fade_width`)): it falls over training from 1 to 0."""
    return 0.5 * (1.0 - math.tanh(0.5 * (progress - config.velocity_fade) / config.velocity_fade_width))


CURRICULA: dict[str, Callable[[float, RewardConfig], float]] = {
    "collision": collision_penalty,
    "velocity_matching": velocity_weight,
}
"""The scale of a term at a progress of the training, 0 … 1."""


def curriculum_scales(progress: float, config: RewardConfig) -> np.ndarray:
    """Return the scale of each term of `CURRICULA`, in its order: (terms,)."""
    return np.array([scale(progress, config) for scale in CURRICULA.values()])


def scaled_terms(terms: Mapping[str, np.ndarray], progress: float, config: RewardConfig) -> dict[str, np.ndarray]:
    """Return weighted terms, (worlds,) each, as they count at a progress of the training; their sum is the reward."""
    return {
        name: term * CURRICULA[name](progress, config) if name in CURRICULA else term for name, term in terms.items()
    }


def weighted_terms(race: Race, car: int, config: RewardConfig, weights: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return weight × term for the last step of a car, (worlds,) each; see `scaled_terms`.

    Args:
        race: after the step, with its outcomes.
        car: the car's number.
        config: constants of the terms.
        weights: by term, of `config.resolved()`.
    """
    return {name: weight * REWARD_TERMS[name](race, car, config) for name, weight in weights.items()}


# `tanh(t / 1e5)` in the paper, whose trainings have three million steps.
COLLISION_GROWTH = {"fast": 0.5, "paper": 1 / 30}  # by preset, share of a training

REWARD_PRESETS: dict[str, dict[str, float]] = {
    # Learns within minutes: progress, and a smooth hand.
    "fast": {
        "progress": 0.1,
        "collision": 1.25,
        "stall": 1.25,
        "steering_change": 0.01,
        "speed_change": 0.01,
        "overtake": 1.0,
        "overtaken": 1.0,
    },
    # The paper's terms with its authors' constants. Their collision penalty could not grow (its
    # maximum was 1, the value it starts from); `collision_max` restores the curriculum that the paper describes.
    "paper": {
        "milestone": 5.0,
        "lap_progress": 100.0,
        "collision": 1.0,
        "velocity_matching": 10.0,
        "steering_change": 0.05,
        "speed_change": 0.0,
        "overtake": 20.0,
        "overtaken": 20.0,
    },
}
