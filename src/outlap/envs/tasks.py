"""Tasks: the track and the parameters of every car, drawn at each reset."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from outlap.envs.car_sets import NO_CAR, CarSet, parameter_ends
from outlap.errors import OutlapError
from outlap.simulator.seeding import CAR_STREAM, PARAMETER_STREAM, TRACK_STREAM, uniform
from outlap.simulator.vehicle import (
    N_PARAMS,
    ActuatorParams,
    LidarParams,
    SensorParams,
    VehicleParams,
    to_records,
)
from outlap.track.track import Track


class Tasks(NamedTuple):
    """Tasks that were drawn for n worlds."""

    tracks: np.ndarray  # int64 (n,) positions in `TaskSet.tracks`
    params: np.ndarray  # PARAMETERS (n, cars)
    cars: np.ndarray  # int64 (n, cars) positions in the list of cars; NO_CAR without a list


@dataclass(frozen=True, eq=False)
class TaskSet:
    """A distribution of tasks: tracks, each as likely as the others, × cars, from ranges or from a list."""

    tracks: tuple[Track, ...]
    vehicle: VehicleParams = field(default_factory=VehicleParams)
    actuators: ActuatorParams = field(default_factory=ActuatorParams)
    lidar: LidarParams = field(default_factory=LidarParams)
    sensors: SensorParams = field(default_factory=SensorParams)
    cars: CarSet | None = None  # in place of the values above

    def __post_init__(self) -> None:
        if not self.tracks:
            raise OutlapError("tracks: none given; at least one is needed")

    @property
    def max_delay(self) -> float:
        """The longest actuator delay that a task can have [s]."""
        high = to_records(self.bounds[1])
        return float(max(high["steer_delay"], high["speed_delay"]))

    @property
    def max_latency(self) -> float:
        """The longest latency of a scan that a task can have [s]."""
        return float(to_records(self.bounds[1])["latency"])

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest value of each parameter of a car: float32 (N_PARAMS,) each."""
        return parameter_ends(self.vehicle, self.actuators, self.lidar, self.sensors, self.cars)

    def draw(self, keys: np.ndarray, episodes: np.ndarray, num_cars: int, egos: np.ndarray | None = None) -> Tasks:
        """Return the tasks of some worlds' next episodes; every car is drawn on its own.

        Args:
            keys: uint64 (n,) of the worlds, from `seeding.world_keys`.
            episodes: (n,) number of each world's episode.
            num_cars: cars a world.
            egos: (n,) numbers in the list of cars that the first cars get; None: drawn too.

        Raises OutlapError for `egos` that are not in a list of cars.
        """
        listed = self.cars.size if self.cars is not None else 0
        if egos is not None and not ((egos >= 0) & (egos < listed)).all():
            raise OutlapError(f"cars: {egos} are not all numbers of the {listed} cars of a list")
        choice = uniform(keys, episodes, TRACK_STREAM, 1)[:, 0]
        low, high = self.bounds
        share = uniform(keys, episodes, PARAMETER_STREAM, num_cars * N_PARAMS)
        share = share.reshape(len(keys), num_cars, N_PARAMS)
        values = np.clip((low + share * (high - low)).astype(np.float32), low, high)
        cars = np.full((len(keys), num_cars), NO_CAR, np.int64)
        if self.cars is not None and self.cars.listed:
            cars = (uniform(keys, episodes, CAR_STREAM, num_cars) * self.cars.size).astype(np.int64)
            if egos is not None:
                cars[:, 0] = egos
            values[..., self.cars.columns] = self.cars.values[cars]
        return Tasks((choice * len(self.tracks)).astype(np.int64), to_records(values), cars)


@dataclass(frozen=True, eq=False)
class TaskSplit:
    """Training tasks and held-out tasks. Code that trains is handed `train` and nothing else."""

    train: TaskSet
    held_out: TaskSet

    def __post_init__(self) -> None:
        both = set(map(_circuit, self.train.tracks)) & set(map(_circuit, self.held_out.tracks))
        if both:
            raise OutlapError(f"tracks: {sorted(both)} are both trained on and held out; take them from one set")


def _circuit(track: Track) -> str:
    """The name of the circuit, whichever way it is driven or seen."""
    return track.name.removesuffix(" mirrored").removesuffix(" reversed")
