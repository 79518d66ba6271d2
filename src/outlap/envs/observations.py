"""Observation terms, each a function of the race and the car.

The first four are the paper's. Each term declares the constant that brings its usual values to about one;
`RaceConfig.scale_observations` divides by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from outlap.envs.car_sets import TRAINING_RANGES, scaled
from outlap.envs.race import Race
from outlap.envs.racing_line import LINE_SPEED, LINE_X, LINE_Y
from outlap.errors import OutlapError
from outlap.simulator import state as column
from outlap.simulator.collision import REMOVED
from outlap.simulator.worlds import FORWARD, HEADING_ERROR, LEFTWARD, OFFSET, SLIP, STEER, YAW_RATE

INF = math.inf
LINE_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0)  # [m] along the centreline
CURVATURE_AHEAD = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.5, 15.0, 20.0, 25.0)  # [m] ahead of the car


@dataclass(frozen=True)
class ObservationTerm:
    """A named part of the observation."""

    read: Callable[[Race, int], np.ndarray]  # (race, car) → (worlds, size), a new array or a view
    low: tuple[float, ...]  # one a number of a block, or one for all
    high: tuple[float, ...]
    scale: tuple[float, ...]
    size: int = 1  # numbers of a block
    blocks: int | Literal["beams", "nearby_cars"] = 1  # or as many as the configuration has


def scan(race: Race, car: int) -> np.ndarray:
    """LiDAR ranges [m], right to left."""
    return race.worlds.scan[:, car]


def pose(race: Race, car: int) -> np.ndarray:
    """x [m], y [m], yaw [rad] in the map frame."""
    return race.worlds.state[:, car, [column.X, column.Y, column.YAW]]


def vel(race: Race, car: int) -> np.ndarray:
    """Velocity forward and to the left [m/s] in the car's frame, yaw rate [rad/s]; as measured."""
    return race.worlds.measured[:, car, [FORWARD, LEFTWARD, YAW_RATE]]


def heading(race: Race, car: int) -> np.ndarray:
    """Steering angle and slip angle [rad]; as measured."""
    return race.worlds.measured[:, car, [STEER, SLIP]]


def previous_action(race: Race, car: int) -> np.ndarray:
    """The action before, (steer, speed) in [-1, 1]; zeros after a reset."""
    return race.actions[:, car]


def previous_reward(race: Race, car: int) -> np.ndarray:
    """The car's reward of the step before, as it is when a training ends: curricula do not change its meaning.

    0 after a reset, and for opponents, whose rewards nobody counts.
    """
    return race.final_rewards[:, car, None]


def vehicle(race: Race, car: int) -> np.ndarray:
    """The parameters of TRAINING_RANGES, -1 … 1 within them. Privileged: no real car knows them."""
    params = race.worlds.params[:, car]
    return scaled(np.stack([params[name] for name in TRAINING_RANGES], axis=1))


def frenet(race: Race, car: int) -> np.ndarray:
    """Offset to the left of the centreline [m] and heading relative to it [rad]. Needs the map."""
    return race.worlds.frenet[:, car, [OFFSET, HEADING_ERROR]]


def curvature_ahead(race: Race, car: int) -> np.ndarray:
    """Curvature of the centreline [1/m] at CURVATURE_AHEAD. Needs the map."""
    return race.line_values(car, "curvature", np.array(CURVATURE_AHEAD))


def line_ahead(race: Race, car: int) -> np.ndarray:
    """The racing line at LINE_AHEAD: x, y [m] in the car's frame and speed [m/s] of each point. Needs the map."""
    state = race.worlds.state[:, car]
    points = race.racing_line[race.line_rows(car, np.array(LINE_AHEAD))]
    dx = points[..., LINE_X] - state[:, column.X, None]
    dy = points[..., LINE_Y] - state[:, column.Y, None]
    cos, sin = np.cos(state[:, column.YAW, None]), np.sin(state[:, column.YAW, None])
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, points[..., LINE_SPEED]], -1).reshape(len(state), -1)


def action_span(race: Race, car: int) -> np.ndarray:
    """What actions mean: steering angle at full lock [rad], speeds that -1 and 1 command [m/s]."""
    lock = race.worlds.params["steer_max"][:, car]
    return np.column_stack([lock, race.speeds[:, car]])


def nearby_cars(race: Race, car: int) -> np.ndarray:
    """The nearest cars, nearest first, zeros where there are fewer; how many: `RaceConfig.nearby_cars`.

    Of each: 1, x and y [m] and heading [rad] in the car's frame, its speed less the car's own [m/s].
    """
    state = race.worlds.state
    own = state[:, car, None]
    dx, dy = state[..., column.X] - own[..., column.X], state[..., column.Y] - own[..., column.Y]
    cos, sin = np.cos(own[..., column.YAW]), np.sin(own[..., column.YAW])
    turn = state[..., column.YAW] - own[..., column.YAW]
    relative = np.stack(
        [
            np.ones_like(dx), cos * dx + sin * dy, cos * dy - sin * dx, np.arctan2(np.sin(turn), np.cos(turn)),
            state[..., column.SPEED] - own[..., column.SPEED],
        ],
        axis=-1,
    )  # fmt: skip
    away = np.where(race.worlds.contact == REMOVED, np.inf, np.hypot(dx, dy))
    away[:, car] = np.inf
    nearest = np.argsort(away, axis=1, kind="stable")[:, : min(race.nearby_cars, state.shape[1] - 1)]
    there = np.isfinite(np.take_along_axis(away, nearest, axis=1))
    out = np.zeros((len(state), race.nearby_cars, relative.shape[-1]), np.float32)
    out[:, : nearest.shape[1]] = np.take_along_axis(relative, nearest[..., None], axis=1) * there[..., None]
    return out.reshape(len(state), -1)


OBSERVATION_TERMS: dict[str, ObservationTerm] = {
    "scan": ObservationTerm(scan, low=(0.0,), high=(INF,), scale=(10.0,), blocks="beams"),
    "pose": ObservationTerm(
        pose, low=(-INF, -INF, -math.pi), high=(INF, INF, math.pi), scale=(50.0, 50.0, math.pi), size=3
    ),
    "vel": ObservationTerm(vel, low=(-INF,), high=(INF,), scale=(10.0, 2.0, 5.0), size=3),
    "heading": ObservationTerm(heading, low=(-math.pi,), high=(math.pi,), scale=(0.4, 0.4), size=2),
    "previous_action": ObservationTerm(previous_action, low=(-1.0,), high=(1.0,), scale=(1.0,), size=2),
    "previous_reward": ObservationTerm(previous_reward, low=(-INF,), high=(INF,), scale=(0.1,), size=1),
    "vehicle": ObservationTerm(vehicle, low=(-INF,), high=(INF,), scale=(1.0,), size=len(TRAINING_RANGES)),
    "frenet": ObservationTerm(frenet, low=(-INF, -math.pi), high=(INF, math.pi), scale=(1.0, 1.0), size=2),
    "curvature_ahead": ObservationTerm(
        curvature_ahead, low=(-INF,), high=(INF,), scale=(0.5,), size=len(CURVATURE_AHEAD)
    ),
    "line_ahead": ObservationTerm(
        line_ahead, low=(-INF,), high=(INF,), scale=(5.0, 5.0, 10.0), size=3, blocks=len(LINE_AHEAD)
    ),
    "nearby_cars": ObservationTerm(
        nearby_cars,
        low=(0.0, -INF, -INF, -math.pi, -INF),
        high=(1.0, INF, INF, math.pi, INF),
        scale=(1.0, 5.0, 5.0, 1.0, 5.0),
        size=5,
        blocks="nearby_cars",
    ),
    "action_span": ObservationTerm(action_span, low=(-INF,), high=(INF,), scale=(0.4, 10.0, 10.0), size=3),
}


def check_terms(terms: Sequence[str], driver: str) -> None:
    """Raise OutlapError that names a driver which observes a term that does not exist."""
    for name in terms:
        if name not in OBSERVATION_TERMS:
            raise OutlapError(f"driver {driver}: observes {name!r}; must be one of {', '.join(OBSERVATION_TERMS)}")


def observation_space(
    terms: Sequence[str], beams: int, max_range: float, nearby_cars: int, scaled: bool
) -> gym.spaces.Dict[Any]:
    """The space of one car's observation.

    Args:
        terms: names of OBSERVATION_TERMS.
        beams: of the scanner; without any, `scan` is an empty array.
        max_range: largest that a scanner can have [m].
        nearby_cars: of which the term `nearby_cars` tells.
        scaled: whether terms are divided by their scale.
    """
    spaces: dict[str, gym.Space[Any]] = {}
    counts = {"beams": beams, "nearby_cars": nearby_cars}
    for name in terms:
        term = OBSERVATION_TERMS[name]
        blocks = term.blocks if isinstance(term.blocks, int) else counts[term.blocks]
        shape = (term.size * blocks,)
        low, high, scale = (_repeated(ends, term.size, shape[0]) for ends in (term.low, term.high, term.scale))
        if name == "scan":
            high = np.full(shape, max_range, np.float32)
        if scaled:
            low, high = low / scale, high / scale
        spaces[name] = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), shape, np.float32)
    return gym.spaces.Dict(spaces)


def scale_of(name: str, size: int) -> np.ndarray:
    """What a term of `size` numbers is divided by where observations are scaled: float32 (size,)."""
    term = OBSERVATION_TERMS[name]
    return _repeated(term.scale, term.size, size)


@lru_cache
def _repeated(block: tuple[float, ...], size: int, count: int) -> np.ndarray:
    """A term's constants, given for a block of numbers or for all, for all of its numbers: float32 (count,)."""
    constants = np.tile(np.broadcast_to(np.asarray(block, np.float32), (size,)), count // size)
    constants.flags.writeable = False  # all that ask for it share it
    return constants


def observe(race: Race, car: int, terms: Sequence[str], scaled: bool) -> dict[str, np.ndarray]:
    """One car's observation in every world: new arrays (worlds, size), float32."""
    observation: dict[str, np.ndarray] = {}
    for name in terms:
        term = OBSERVATION_TERMS[name]
        value = term.read(race, car)
        if scaled:
            # Divided as the space's bounds are: times the reciprocal could round to just outside of them.
            observation[name] = np.divide(value, scale_of(name, value.shape[1]), dtype=np.float32)
        else:
            observation[name] = np.array(value, dtype=np.float32)
    return observation
