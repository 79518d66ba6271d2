"""Draw the test cars: splits by their distance from the training ranges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.drivers.classical import PurePursuit
from outlap.envs.car_sets import HALVES, MIDDLES, TRAINING_RANGES, CarSet
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.terminations import FINISHED, TerminationConfig
from outlap.errors import OutlapError
from outlap.simulator.vehicle import VehicleParams
from outlap.track.track import Track

SHELLS = {"inside": (0.0, 0.8), "edge": (0.8, 1.0), "outside": (1.0, 1.5), "hard": (1.0, 1.5)}
"""The range of max |u| of each split, where u are a car's parameters as `car_sets.scaled` scales them."""

SPEED_SHARES = (0.7, 0.5, 0.35, 0.25)  # of the centreline's speeds, at which a car may prove that it can be driven
BATCH = 64


class DrawnSplit(NamedTuple):
    """The cars of a split, and how many were redrawn since nobody could drive them."""

    cars: CarSet
    redrawn: int


def draw_split(split: str, count: int, seed: int, tracks: list[Track]) -> DrawnSplit:
    """Draw the test cars of a split.

    The largest |u| is uniform in the split's range, so that cars lie at all distances from the training ranges; in many
    dimensions, uniform values of each parameter alone would put nearly every car at the far end. Parameters beside
    the largest one are uniform. Cars of `hard` have every parameter on the difficult side. A car that a planner which
    knows the track cannot drive round a lap at any of four speeds is redrawn.

    Args:
        split: a key of SHELLS.
        count: cars.
        seed: of the draws.
        tracks: on each of which a car must be able to drive a lap.

    Raises OutlapError for an unknown split.
    """
    if split not in SHELLS:
        raise OutlapError(f"split is {split!r}; must be one of {', '.join(SHELLS)}")
    rng = np.random.default_rng([seed, list(SHELLS).index(split)])
    kept: list[np.ndarray] = []
    redrawn = 0
    while len(kept) < count:
        cars = _draw(split, BATCH, rng)
        for values, drivable in zip(cars.values, _drivable(cars, tracks), strict=True):
            if len(kept) == count:
                break
            if drivable:
                kept.append(values)
            else:
                redrawn += 1
    return DrawnSplit(CarSet(split, tuple(TRAINING_RANGES), np.stack(kept), listed=True), redrawn)


def _draw(split: str, count: int, rng: np.random.Generator) -> CarSet:
    u = rng.uniform(-1.0, 1.0, (count, len(MIDDLES)))
    low, high = SHELLS[split]
    # 1 - share is in (0, 1]: the lower end of a shell belongs to the one inside.
    u *= (high - (high - low) * rng.random((count, 1))) / np.abs(u).max(axis=1, keepdims=True)
    if split == "hard":
        u = np.abs(u) * np.array([each.difficult for each in TRAINING_RANGES.values()])
    never_negative = np.array([name.endswith("_delay") for name in TRAINING_RANGES])
    values = MIDDLES + u * HALVES
    values = np.where(never_negative & (values < 0.0), MIDDLES - u * HALVES, values)
    return CarSet(split, tuple(TRAINING_RANGES), values.astype(np.float32), listed=True)


def _drivable(cars: CarSet, tracks: list[Track]) -> np.ndarray:
    """Whether each car completes a lap of every track at one of the speeds: bool (cars,)."""
    config = RaceConfig(
        model="nonlinear_single_track", beams=0, control_interval=4, vehicle=VehicleParams(v_max=8.0),
        observation=PurePursuit().observation_terms, start=StartConfig(anywhere=False, offset=0.0, heading_error=0.0),
    )  # fmt: skip
    drivable = np.ones(cars.size, bool)
    for track in tracks:
        rules = TerminationConfig(laps=1, time_limit=track.centerline.length / 0.4)
        task = config.model_copy(update={"termination": rules})
        env = RaceVectorEnv(cars.size, task, [track], cars=cars, autoreset_mode=AutoresetMode.DISABLED)
        finished = np.zeros(cars.size, bool)
        for share in SPEED_SHARES:
            finished |= _laps(env, PurePursuit(speed_share=share))
        drivable &= finished
    return drivable


def _laps(env: RaceVectorEnv, driver: PurePursuit) -> np.ndarray:
    """Whether a driver completes a lap with each car: bool (cars,)."""
    observation, _ = env.reset(seed=0, options={"cars": np.arange(env.num_envs)})
    finished, over = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
    while not over.all():
        observation, _, terminated, truncated, info = env.step(driver.act(observation))
        new = (terminated | truncated) & ~over
        finished |= new & (info["outcome"] == FINISHED)
        over |= new
        again = terminated | truncated
        if again.any():
            observation, _ = env.reset(options={"reset_mask": again, "cars": np.arange(env.num_envs)})
    return finished
