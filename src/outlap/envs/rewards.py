"""Reward terms, a function a term, and the presets that weigh them.

A term is unweighted: (worlds,) float of one car. The reward is the sum of weight × term. Constants: `RewardConfig`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from outlap.config import Config
from outlap.envs.race import Race
from outlap.envs.terminations import STALLED

CURRICULA_OVER = 10**12  # training steps at which every curriculum is at its end


class RewardConfig(Config):
    """Which terms count, how much, and their constants.

    The curricula count environment steps of all worlds together since training began.
    """

    preset: Literal["fast", "paper"] = "fast"  # where weights come from
    weights: dict[str, float] = Field(default={})  # by term, in place of the preset's
    milestones: int = Field(default=10, ge=1)  # per lap
    collision_max: float = Field(default=10.0, ge=1)  # to which the collision penalty grows; 1 = never grows
    collision_steps: float = Field(default=1e5, gt=0)  # over which it grows
    velocity_step: float = 1e6  # at which the weight of velocity matching has halved
    velocity_width: float = Field(default=1e5, gt=0)  # [steps] of that fall

    @model_validator(mode="before")
    @classmethod
    def _from_preset_name(cls, value: Any) -> Any:
        return {"preset": value} if isinstance(value, str) else value

    @field_validator("weights")
    @classmethod
    def _known_terms(cls, weights: dict[str, float]) -> dict[str, float]:
        for name in weights:
            if name not in REWARD_TERMS:
                raise ValueError(f"{name!r} is not a reward term; there are {', '.join(REWARD_TERMS)}")
        return weights

    def without_curricula(self) -> RewardConfig:
        """The reward after `CURRICULA_OVER` steps, without the term that is zero then: it needs planned lines."""
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
    """-(1 + (c_max - 1) tanh(t / T)) where the car crashed: a penalty that grows over training."""
    growth = np.tanh(race.training_steps / config.collision_steps)
    return np.where(race.crashed[:, car], -(1.0 + (config.collision_max - 1.0) * growth), 0.0)


def stall(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-1 where the episode ends because the car gets no further: else a careful policy would rather stand."""
    return -(race.outcome[:, car] == STALLED).astype(np.float64)


def velocity_matching(race: Race, car: int, config: RewardConfig) -> np.ndarray:
    """-(v - v_ref)^2 w(t) [m^2/s^2]: v_ref on the minimum-time line; w falls over training from 1 to 0 as a sigmoid."""
    assert race.reference is not None  # the environment has it where this term counts
    reference = race.reference.at(car, race.worlds.track, race.line_rows(car, np.zeros(1))[:, 0])
    x = (race.training_steps - config.velocity_step) / config.velocity_width
    weight = 0.5 * (1.0 - np.tanh(0.5 * x))
    return -weight * (race.speed[:, car] - reference) ** 2


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


def weighted_terms(race: Race, car: int, config: RewardConfig, weights: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return weight × term for the last step of a car, (worlds,) each; their sum is its reward.

    Args:
        race: after the step, with its outcomes.
        car: the car's number.
        config: constants of the terms.
        weights: by term, of `config.resolved()`.
    """
    return {name: weight * REWARD_TERMS[name](race, car, config) for name, weight in weights.items()}


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
