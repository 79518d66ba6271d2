"""Observation terms: what a car can be told, each a function of the race and the car.

The first four are the paper's. Each term declares the constant that brings its usual values to about one;
`RaceConfig.scale_observations` divides by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from outlap.envs.race import EGO, Race
from outlap.simulator import state as column
from outlap.simulator.kernels import HEADING_ERROR, OFFSET
from outlap.track.centerline import CURVATURE

INF = math.inf
CURVATURE_AHEAD = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.5, 15.0, 20.0, 25.0)  # [m] ahead of the car


@dataclass(frozen=True)
class ObservationTerm:
    """A named part of the observation."""

    read: Callable[[Race, int], np.ndarray]  # (race, car) → (worlds, size), a new array or a view
    low: tuple[float, ...]  # one a number, or one for all
    high: tuple[float, ...]
    scale: tuple[float, ...]
    size: int | None = None  # None: as many numbers as beams


def scan(race: Race, car: int) -> np.ndarray:
    """LiDAR ranges [m], right to left."""
    return race.worlds.scan[:, car]


def pose(race: Race, car: int) -> np.ndarray:
    """x [m], y [m], yaw [rad] in the map frame."""
    return race.worlds.state[:, car, [column.X, column.Y, column.YAW]]


def vel(race: Race, car: int) -> np.ndarray:
    """Velocity forward and to the left [m/s] in the car's frame, yaw rate [rad/s]."""
    state = race.worlds.state[:, car]
    speed, slip = state[:, column.SPEED], state[:, column.SLIP]
    return np.stack([speed * np.cos(slip), speed * np.sin(slip), state[:, column.YAW_RATE]], axis=1)


def heading(race: Race, car: int) -> np.ndarray:
    """Steering angle and slip angle [rad]."""
    return race.worlds.state[:, car, [column.STEER, column.SLIP]]


def previous_action(race: Race, car: int) -> np.ndarray:
    """The action before, (steer, speed) in [-1, 1]; zeros after a reset."""
    return race.actions[:, car]


def previous_reward(race: Race, car: int) -> np.ndarray:
    """The ego's reward of the step before; 0 after a reset. No reward is counted for other cars: 0."""
    return race.rewards[:, None] if car == EGO else np.zeros_like(race.rewards)[:, None]


def frenet(race: Race, car: int) -> np.ndarray:
    """Offset to the left of the centreline [m] and heading relative to it [rad]. Needs the map."""
    return race.worlds.frenet[:, car, [OFFSET, HEADING_ERROR]]


def curvature_ahead(race: Race, car: int) -> np.ndarray:
    """Curvature of the centreline [1/m] at CURVATURE_AHEAD. Needs the map."""
    return race.line_values(car, CURVATURE, np.array(CURVATURE_AHEAD))


OBSERVATION_TERMS: dict[str, ObservationTerm] = {
    "scan": ObservationTerm(scan, low=(0.0,), high=(INF,), scale=(10.0,)),
    "pose": ObservationTerm(
        pose, low=(-INF, -INF, -math.pi), high=(INF, INF, math.pi), scale=(50.0, 50.0, math.pi), size=3
    ),
    "vel": ObservationTerm(vel, low=(-INF,), high=(INF,), scale=(10.0, 2.0, 5.0), size=3),
    "heading": ObservationTerm(heading, low=(-math.pi,), high=(math.pi,), scale=(0.4, 0.4), size=2),
    "previous_action": ObservationTerm(previous_action, low=(-1.0,), high=(1.0,), scale=(1.0,), size=2),
    "previous_reward": ObservationTerm(previous_reward, low=(-INF,), high=(INF,), scale=(0.1,), size=1),
    "frenet": ObservationTerm(frenet, low=(-INF, -math.pi), high=(INF, math.pi), scale=(1.0, 1.0), size=2),
    "curvature_ahead": ObservationTerm(
        curvature_ahead, low=(-INF,), high=(INF,), scale=(0.5,), size=len(CURVATURE_AHEAD)
    ),
}


def observation_space(terms: Sequence[str], beams: int, max_range: float, scaled: bool) -> gym.spaces.Dict:
    """The space of one car's observation.

    Args:
        terms: names of OBSERVATION_TERMS.
        beams: of the scanner; without any, `scan` is an empty array.
        max_range: largest that a scanner can have [m].
        scaled: whether terms are divided by their scale.
    """
    spaces: dict[str, gym.Space] = {}
    for name in terms:
        term = OBSERVATION_TERMS[name]
        shape = (beams if term.size is None else term.size,)
        low, high, scale = (
            np.broadcast_to(np.asarray(ends, np.float32), shape) for ends in (term.low, term.high, term.scale)
        )
        if name == "scan":
            high = np.full(shape, max_range, np.float32)
        if scaled:
            low, high = low / scale, high / scale
        spaces[name] = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), shape, np.float32)
    return gym.spaces.Dict(spaces)


def observe(race: Race, car: int, terms: Sequence[str], scaled: bool) -> dict[str, np.ndarray]:
    """One car's observation in every world: new arrays (worlds, size), float32."""
    observation = {}
    for name in terms:
        term = OBSERVATION_TERMS[name]
        value = term.read(race, car)
        if scaled:
            # Divided as the space's bounds are: times the reciprocal could round to just outside of them.
            observation[name] = np.divide(value, np.asarray(term.scale, np.float32), dtype=np.float32)
        else:
            observation[name] = np.array(value, dtype=np.float32)
    return observation
